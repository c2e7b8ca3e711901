# The same install as `make install`, and JupyterLab on the notebook beside the paper:
#   docker build -t f3amd . && docker run --rm -p 8888:8888 f3amd
# Results stay with `-v "$PWD/runs:/f3amd/runs"`.
FROM python:3.12-slim-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends git make && rm -rf /var/lib/apt/lists/*
WORKDIR /f3amd
COPY . .
RUN make install
EXPOSE 8888
CMD ["make", "lab", "LAB_OPTIONS=--ip=0.0.0.0 --allow-root --no-browser"]
