"""Events as they come -> pictures at once: a camera, a stream or a recording played at its speed.

    sources        camera, socket, standard input, growing file, replay -> events as they arrive
    engine         arrivals -> windows -> pictures; drops whole windows rather than lag behind
    page           the newest picture and what is measured -> a page on this machine

Read `engine` first: one thread reads and cuts windows, one computes, the page only looks.
"""
