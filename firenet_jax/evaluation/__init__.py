"""Images beside truth -> numbers: metrics, methods that are compared, and the report of them.

metrics        pure JAX functions of (..., H, W) images: SSIM, NLPD, HaarPSI, ...
equalise       histogram equalisation, hard and soft
lpips          LPIPS by weights that the user names
methods        whatever makes images of events, behind one interface; `baselines` are some
protocol       which frames of a recording count; a method on a recording -> numbers
comparison     images of a method, frames of a camera -> numbers, batch by batch
results        the metrics by name; numbers of frames -> means, and why one is not there
report         results -> table, CSV, a page of HTML; only presents
"""
