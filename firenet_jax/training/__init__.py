"""Sequences -> weights: the loss, batches from files, the jitted step, a run that resumes.

    losses         Eq. 2 of the paper, and the distances that it can use
    batches        HDF5 sequences -> batches, augmented
    step           (parameters, data) -> parameters: simulate, scan, differentiate, update
    settings       the options of `firenet train`
    log            losses, pictures and weights of a run, on disk
    recordings     recordings with frames -> sequences, and how well weights do on the end held out
    run            all of these together, in a folder from which a run resumes

Read `step.train_step` first.
"""
