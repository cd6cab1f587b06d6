"""What goes to disk and how -> files that are whole; and what is seen meanwhile.

Knows nothing of the network and its data. Read `files` first.

    files          each file is made beside its name and gets it in the end; locks
    runs           a folder, its settings, what is done: how a command goes on
    video          pictures -> a folder of png, mp4, gif
    disk           a file for HDF5 that says when the disk is full
    arrays         images -> one HDF5 file of float32
    bag            pictures -> ROS 1 and ROS 2 bags
    pytorch_file   PyTorch's files -> numpy arrays, running nothing that they hold
    pytorch_save   numpy arrays -> PyTorch's files
    overlap        an iterator, run ahead in a thread
    progress       bars, and lines where there is no terminal
"""
