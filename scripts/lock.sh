#!/usr/bin/env bash
# Write requirements.lock anew from pyproject.toml: exact versions with hashes, one file for every
# platform and for Python 3.11 and newer; behind the plain install what each extra adds. For maintainers; it needs the
# network and changes nothing but the lock. Pins of bench and onnx stay: raise them by hand. Look at the difference, run `make test`.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="${F3AMD_PYTHON:-python3}"
tools="$(mktemp -d)"
trap 'rm -rf "$tools"' EXIT

echo "Installing uv into a folder that is removed afterwards ..."
"$python" -m venv "$tools"
"$tools/bin/python" -m pip install --quiet uv

# No header and no index addresses: the file names packages and hashes, never where they came from.
compile() {
  "$tools/bin/uv" pip compile pyproject.toml --quiet --no-config --universal --python-version 3.11 \
    --generate-hashes --no-header --no-emit-index-url --no-emit-find-links "$@"
}

# What is pinned stays where it fits, unless an option says otherwise (--upgrade): uv reads the file that it writes.
sed '/^# Extras/,$d' requirements.lock >"$tools/plain"
sed -n '/^# Extras/,$p' requirements.lock >"$tools/extras"
compile --extra notebooks --extra tests --extra text --group build "$@" --output-file "$tools/plain"
for extra in site sweep web; do
  grep -v '^#' "$tools/extras" >"$tools/$extra" || true
  compile --extra "$extra" --constraints "$tools/plain" --no-annotate "$@" --output-file "$tools/$extra"
done
cat "$tools/plain" "$tools/extras" >requirements.lock
"$python" scripts/lock_extras.py site="$tools/site" sweep="$tools/sweep" web="$tools/web"
echo "requirements.lock is written. Next: git diff requirements.lock, then make test."
