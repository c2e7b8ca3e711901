#!/usr/bin/env bash
# Add an extra to .venv, in the versions of requirements.lock: bash scripts/extra.sh bench|onnx|site|sweep|web [options of pip]
# What has hashes is checked against them, and nothing else is resolved or downloaded; bench and onnx have none (the lock
# says why), so pip adds what they need. Of thousands of modules few are ever imported; Python compiles those that are.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

name="${1:?which extra? bench, onnx, site, sweep or web}"
wanted="$(mktemp)"
trap 'rm -f "$wanted"' EXIT
# An entry of the lock is a line and the indented ones below it; `extra` means nothing to pip here.
awk -v name="extra == '$name'" '/^[^ #]/ { taken = index($0, name) } taken' requirements.lock |
  sed "s/extra == '$name'/python_version >= '3'/" >"$wanted"
if [ ! -s "$wanted" ]; then
  echo "requirements.lock has no extra $name" >&2
  exit 2
fi
options=()
if grep -q -- --hash= "$wanted"; then options=(--require-hashes --no-deps); fi
"${F3AMD_VENV:-.venv}/bin/python" -m pip install --disable-pip-version-check --progress-bar off --retries 1 --timeout 15 \
  --no-compile -q "${options[@]}" "${@:2}" -r "$wanted"
