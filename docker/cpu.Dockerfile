# The wheel alone -> an image that runs `firenet` on a CPU.
#
#   python -m build
#   docker build -f docker/cpu.Dockerfile -t firenet .
#   docker run --rm -v "$PWD:/data" firenet reconstruct recording.zip -o video.mp4
FROM python:3.13-slim

COPY dist/firenet_jax-*.whl /tmp/
RUN pip install --no-cache-dir "$(ls -t /tmp/firenet_jax-*.whl | head -1)[formats]" && rm /tmp/firenet_jax-*.whl

# It runs as an unprivileged user. To own the files that it writes, add --user "$(id -u):$(id -g)".
RUN useradd --create-home firenet
USER firenet
WORKDIR /data
ENTRYPOINT ["firenet"]
CMD ["--help"]
