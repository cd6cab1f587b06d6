"""Images, ground truth -> numbers: metrics, the methods compared, and the report on them.

metrics        pure JAX functions of (..., H, W) images: SSIM, NLPD, HaarPSI, ...
equalise       histogram equalisation, hard and soft
lpips          LPIPS by weights that the user names
methods        all that turn events into images, behind one interface (some in `baselines`)
protocol       which frames of a recording count; a method on a recording -> numbers
comparison     images of a method, frames of a camera -> numbers, batch by batch
results        the metrics by name; numbers of frames -> means, and reasons for missing ones
report         results -> table, CSV, a page of HTML; only presents
"""
