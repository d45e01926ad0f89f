# docker build -t legcal . && docker run --rm -v "$PWD":/work legcal calibrate dataset -o calibrated
FROM python:3.12-slim AS build
COPY . /src
RUN python -m venv /opt/legcal && /opt/legcal/bin/pip install --no-cache-dir -c /src/constraints.txt /src

FROM python:3.12-slim
# Pinocchio's module is linked with OpenMP, which slim images leave out.
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/legcal /opt/legcal
ENV PATH=/opt/legcal/bin:$PATH
WORKDIR /work
ENTRYPOINT ["legcal"]
