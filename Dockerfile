# Headway with SUMO, Ray, ONNX and its pages. docs/howto/docker.md says how to build and run it.
FROM python:3.12-slim

# The libraries that SUMO's wheel expects of the system.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        libatomic1 libexpat1 libgl1 libx11-6 libxext6 libxrender1 \
    && rm -rf /var/lib/apt/lists/*

# The owner of the runs: the user's own number, if `runs` is a folder outside.
ARG UID=1000
RUN useradd --create-home --uid "$UID" headway
USER $UID
WORKDIR /home/headway
ENV PATH=/home/headway/venv/bin:$PATH
RUN python -m venv venv && mkdir runs

# Options of pip, as in the Makefile.
ARG PIP_ARGS=""
COPY --chown=headway . checkout
# hadolint ignore=SC2086
RUN pip install --no-cache-dir $PIP_ARGS -c checkout/constraints.txt "./checkout[sumo,browse,ray,export]" \
    && python -m headway_launch.runner.warm_up

VOLUME /home/headway/runs
ENTRYPOINT ["headway"]
CMD ["--help"]
