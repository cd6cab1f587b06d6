"""What goes to disk and how -> files that are whole; and what is shown meanwhile.

Knows nothing of the network. Read `files` first.

    files          each file is made under a name beside its own and renamed when whole; locks
    runs           a folder, its settings, what is done: how an interrupted command goes on
    resume         which outputs are done, and how far an unfinished folder of pictures is
    video          pictures -> a folder of png, mp4, gif
    disk           a file for HDF5 that says when the disk is full
    sequence_file  events and pictures -> one HDF5 file to train on
    arrays         images -> one HDF5 file of float32
    bag            pictures -> ROS 1 and ROS 2 bags
    pytorch_file   PyTorch's files -> numpy arrays, without running code in them
    pytorch_save   numpy arrays -> PyTorch's files
    overlap        an iterator, run ahead in a thread
    progress       bars, and lines where there is no terminal
    screen         pictures -> a window
"""
