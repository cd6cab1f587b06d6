# The wheel alone -> an image that runs `firenet` on NVIDIA GPUs. The CUDA libraries come with jax;
# the host has the driver (525 or newer) and NVIDIA's container toolkit.
#
#   python -m build
#   docker build -f docker/cuda.Dockerfile -t firenet-cuda .
#   docker run --rm --gpus all -v "$PWD:/data" firenet-cuda reconstruct recording.zip -o video.mp4
FROM python:3.13-slim

COPY dist/firenet_jax-*.whl /tmp/
# jax within the bounds of the wheel, whose reasons stand in pyproject.toml.
RUN pip install --no-cache-dir "$(ls -t /tmp/firenet_jax-*.whl | head -1)[formats]" "jax[cuda12]<0.11,!=0.10.2" \
    && rm /tmp/firenet_jax-*.whl

RUN useradd --create-home firenet
USER firenet
WORKDIR /data
ENTRYPOINT ["firenet"]
CMD ["--help"]
