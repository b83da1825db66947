#!/usr/bin/env bash
# Packages all crates that are published, in the order of their dependencies, into target/package, and checks
# that no source of a package includes a file outside of it.
#
#   scripts/package.sh                            as CI does: without a registry, and without building
#   scripts/package.sh --publish REPOSITORY-URL   writes the URL into the manifests, builds every package from
#                                                 its archive, and uploads it
set -euo pipefail
cd "$(dirname "$0")/.."
published=(--workspace --exclude qudi-python)

if [ "${1:-}" = --publish ]; then
    url=${2:?the URL of the repository}
    sed -i.bak "s|^license.workspace = true|&\nrepository = \"$url\"|" crates/*/Cargo.toml
    rm crates/*/Cargo.toml.bak
    # Changed are the manifests alone: the tag names the commit.
    exec cargo publish "${published[@]}" --locked --allow-dirty
fi

packages=${CARGO_TARGET_DIR:-target}/package
rm -rf "$packages"
cargo package "${published[@]}" --no-verify --offline --locked --allow-dirty --quiet
failed=0
for archive in "$packages"/*.crate; do
    tar -xzf "$archive" -C "$packages"
    if [ "$(wc -c <"$archive")" -gt 10485760 ]; then
        echo "$archive: more than 10 MiB, which registries refuse" >&2
        failed=1
    fi
done
# Included files by a name, or by a name that a macro completes: then the folder must exist.
while IFS=: read -r file path; do
    path=${path##*(\"}
    if [ ! -e "$(dirname "$file")/${path%\"*}" ]; then
        echo "$file: $path is not in the package" >&2
        failed=1
    fi
done < <(grep -roE 'include_(str|bytes)!\((concat!\()?"[^"]+"' --include='*.rs' "$packages"/*/src)
exit $failed
