"""key -> sequences with truth and optical flow: photographs, motion, sensor.

    textures       photographs, cut at random, and drawn ones
    scenes         textures and motion -> intensity at any time, with exact flow
    sensor         intensity -> events
    sequences      sensors before scenes -> event tensors and truth, which never leave the device
    curricula      which sensors look at which scenes: the sequences of a training
    clip           a video file -> grey pictures, the sensor's input in place of a scene

Read `scenes` first, then `sensor.step`: one model of a pixel with all its faults.
"""
