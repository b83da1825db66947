# Recipes; `just` lists them.

default:
    @just --list

# Everything CI runs
ci:
    .ci/run

# The test suite
test:
    cargo test --workspace

# The Python package in this tree: its module, and its tests with the Python of an environment that has
# crates/qudi-python/tests/requirements.txt
test-python python="python3":
    cargo build --workspace --lib --tests
    cp target/debug/libqudi_python.* crates/qudi-python/python/qudi_spad/_native.abi3.so
    cd crates/qudi-python && QT_QPA_PLATFORM=offscreen {{python}} -m pytest

# Formatting and lints
lint:
    cargo fmt --all --check
    cargo clippy --workspace --all-targets --features qudi-cli/wgpu -- -D warnings

# API documentation
doc:
    cargo doc --workspace --no-deps --open

# The documentation as a site in target/site; `pip install -r scripts/site-requirements.txt` has mdBook
site:
    cargo doc --workspace --no-deps
    python3 scripts/site.py --build target/site

# Packages of all crates in target/package
package:
    scripts/package.sh

# Nanoseconds per pixel of the camera, seconds per window of the classical methods
bench:
    cargo bench -p qudi-core
    cargo bench -p qudi-burst

# The pictures of README and quick start
picture:
    cargo run --release -- demo --animate -o target/demo.png --force
    cp target/demo.png target/demo.gif docs/images/

# The settings reference, from the program itself
config-docs:
    cargo run -- config docs > docs/settings.md
