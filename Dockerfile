# docker build -t slatprep .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" -v slatprep:/home/slatprep/.cache slatprep --help
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
# Any user may run it, as files under /data are to belong to who calls. Numba compiles for the
# processor it finds, so not here; a volume on the cache keeps what it compiled.
RUN useradd --no-create-home --uid 1000 slatprep \
    && mkdir --parents --mode=1777 /home/slatprep/.cache \
    && chmod 1777 /home/slatprep
ENV PATH=/opt/slatprep/bin:$PATH HOME=/home/slatprep
# A number, as Kubernetes sees only of a number that it is not root.
USER 1000
WORKDIR /data
ENTRYPOINT ["slatprep"]
CMD ["--help"]
