# curate on the CPU. Build: docker build -t curate .   Run: docker run --rm -v "$PWD:/data" curate demo
FROM python:3.12-slim-bookworm AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE curate_command.py ./
COPY curate curate
COPY db db
COPY pipelines pipelines
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim-bookworm
COPY .ci/check_system.py constraints.txt /tmp/
RUN python /tmp/check_system.py && rm -rf /var/lib/apt/lists/*
# The CPU build of torch is a tenth of the size of the general one.
ARG PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir -c /tmp/constraints.txt torch==2.13.0+cpu \
    && pip install --no-cache-dir -c /tmp/constraints.txt "$(echo /wheels/*.whl)[postgres,serve,nuscenes,parquet]" \
    && rm -rf /wheels /tmp/check_system.py /tmp/constraints.txt
RUN useradd --create-home curate && mkdir /data && chown curate /data
USER curate
WORKDIR /data
ENTRYPOINT ["curate"]
CMD ["--help"]
