"""Sequences -> weights: the loss, batches from files, the jitted step, a run that resumes.

    losses         Eq. 2 of the paper, with the distances that it may be made of
    batches        HDF5 sequences -> batches, augmented
    step           (parameters, data) -> parameters: simulate, scan, differentiate, update
    settings       what `firenet train` asks for
    log            losses, pictures and weights of a run, on disk
    run            all of these together, in a folder where it goes on

Read `step.train_step` first.
"""
