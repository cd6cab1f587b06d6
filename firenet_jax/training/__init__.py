"""Sequences -> weights: the loss, batches from files, the jitted step, a run that resumes.

    losses         Eq. 2 of the paper, with the distances that it may be made of
    batches        HDF5 sequences -> batches, augmented
    run            the step (`train_step`), and the run with its folder

Read `run.train_step` first: simulate, scan, differentiate, update.
"""
