# slatprep as a command: docker build -t slatprep . && docker run -v "$PWD:/data" slatprep --help
FROM python:3.12-slim-bookworm AS build
WORKDIR /src
COPY requirements/run.txt requirements/
RUN python -m venv /opt/slatprep \
    && /opt/slatprep/bin/pip install --no-cache-dir --no-deps --requirement requirements/run.txt
COPY pyproject.toml README.md LICENSE MANIFEST.in ./
COPY slatprep slatprep
RUN /opt/slatprep/bin/pip install --no-cache-dir --no-deps .

FROM python:3.12-slim-bookworm
COPY --from=build /opt/slatprep /opt/slatprep
RUN useradd --create-home --uid 1000 slatprep
USER slatprep
# Numba compiles for the processor it finds, so not here; a volume keeps what it compiled.
ENV PATH=/opt/slatprep/bin:$PATH NUMBA_CACHE_DIR=/home/slatprep/.cache/numba
WORKDIR /data
ENTRYPOINT ["slatprep"]
CMD ["--help"]
