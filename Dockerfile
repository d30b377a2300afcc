# curate on the CPU. Build it with `docker build -t curate .`, then run it in a folder with your data:
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" curate demo
FROM python:3.12-slim-bookworm AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE curate_command.py ./
COPY curate curate
COPY db db
COPY pipelines pipelines
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim-bookworm
COPY .ci/check_system.py /setup/.ci/
COPY curate/simulation/system_libraries.py /setup/curate/simulation/
RUN python /setup/.ci/check_system.py && rm -rf /var/lib/apt/lists/*
# The CPU build of torch is a tenth of the size of the general one.
ARG PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
COPY constraints.txt /setup/
COPY --from=build /wheels /setup/wheels
RUN pip install --no-cache-dir -c /setup/constraints.txt torch==2.13.0+cpu \
    && pip install --no-cache-dir -c /setup/constraints.txt \
        "$(echo /setup/wheels/*.whl)[postgres,serve,nuscenes,parquet]" \
    && rm -rf /setup
# Any user id may run it: compiled kernels are kept in a folder that everyone can write.
ENV HOME=/tmp NUMBA_CACHE_DIR=/tmp/numba
WORKDIR /data
USER nobody
ENTRYPOINT ["curate"]
CMD ["--help"]
