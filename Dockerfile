# An image with the program, its weights and ffmpeg:
#
#   docker build -t qudi --build-arg COMMIT="$(git rev-parse HEAD)" .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/work" qudi restore burst.npy -o restored
#
# FEATURES is empty for processors; `cuda` and `vulkan` need the card's libraries in the last stage, too.
FROM rust:1.95.0-bookworm AS build
ARG FEATURES=""
ARG COMMIT=""
WORKDIR /source
COPY . .
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/source/target \
    if [ -n "$COMMIT" ]; then export QUDI_COMMIT="$COMMIT"; fi \
    && cargo build --locked --profile dist -p qudi-cli --bin qudi --features "$FEATURES" \
    && cp target/dist/qudi /usr/local/bin/qudi \
    && qudi man /usr/local/share/man/man1

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends ffmpeg \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /usr/local/bin/qudi /usr/local/bin/qudi
COPY --from=build /usr/local/share/man/man1 /usr/local/share/man/man1
COPY LICENSE-APACHE LICENSE-MIT /usr/local/share/doc/qudi/
WORKDIR /work
ENTRYPOINT ["qudi"]
CMD ["--help"]
