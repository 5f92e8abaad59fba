# docker build --tag asbuilt . && docker run --rm -v "$PWD:/work" asbuilt identify arm.urdf log.csv --out study
FROM python:3.13-slim AS wheel
COPY pyproject.toml README.md LICENSE /source/
COPY src /source/src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.13-slim
# Byte code would be a sixth of the image; Python makes what a command needs.
RUN --mount=from=wheel,source=/wheels,target=/wheels \
    pip install --no-cache-dir --no-compile /wheels/*.whl \
    && useradd --create-home --uid 1000 asbuilt \
    && install --directory --owner asbuilt /work
USER asbuilt
WORKDIR /work
# Machine code of the first command; kept where only this user writes.
ENV NUMBA_CACHE_DIR=/home/asbuilt/.cache/numba
ENTRYPOINT ["asbuilt"]
CMD ["--help"]
