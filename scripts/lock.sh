#!/usr/bin/env bash
# Write requirements.lock anew from pyproject.toml: exact versions with hashes, one file for every
# platform and for Python 3.11 and newer. For maintainers; it needs the network and changes nothing
# but the lock. Look at the difference, run `make test`, and note a moved figure in CHANGELOG.md.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="${F3AMD_PYTHON:-python3}"
tools="$(mktemp -d)"
trap 'rm -rf "$tools"' EXIT

echo "Installing uv into a folder that is removed afterwards ..."
"$python" -m venv "$tools"
"$tools/bin/python" -m pip install --quiet uv

# No header and no index addresses: the file names packages and hashes, never where they came from.
"$tools/bin/uv" pip compile pyproject.toml --quiet --no-config \
  --extra notebooks --extra tests --extra text --group build --universal --python-version 3.11 \
  --generate-hashes --no-header --no-emit-index-url --no-emit-find-links \
  "$@" --output-file requirements.lock
echo "requirements.lock is written. Next: git diff requirements.lock, then make test."
