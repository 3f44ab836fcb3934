# docker build -t lagros . && docker run --rm lagros bench cartpole --episodes 5
FROM python:3.11-slim
WORKDIR /lagros
COPY . .
RUN pip install --no-cache-dir --require-hashes -r locked/bench.txt \
  && pip install --no-cache-dir --no-deps .
ENV OMP_NUM_THREADS=1 MPLBACKEND=Agg SDL_VIDEODRIVER=dummy
WORKDIR /work
ENTRYPOINT ["lagros"]
