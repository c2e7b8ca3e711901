#!/usr/bin/env bash
# Bundle three.js for the pages: f3amd_companion/serving/web/three.min.js, of the parts named in three_parts.js. For maintainers; it
# needs Node, npm and the network. Package and result are checked against their hashes; `--update` writes the result's anew.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

three="0.187.0"
three_integrity="sha512-Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA=="
esbuild="0.28.2"
esbuild_integrity="sha512-HKVLS8dvII+xoKW9kmqxbRKrnWEXfJJr/FZhhJmiqIB0e053QNYFqOBouTMO/k5sID4MvCiUCvv8b9M4h32wIA=="
web="f3amd_companion/serving/web"
tools="$(mktemp -d)"
trap 'rm -rf "$tools"' EXIT

printf '{"private": true, "dependencies": {"three": "%s", "esbuild": "%s"}}' "$three" "$esbuild" > "$tools/package.json"
npm install --prefix "$tools" --no-audit --no-fund --silent
for wanted in "$three_integrity" "$esbuild_integrity"; do
  grep -qF "$wanted" "$tools/package-lock.json" || { echo "Stopped: a package is not the one that was checked." >&2; exit 1; }
done
cp "$web/three_parts.js" "$tools/"
{
  echo "/*! three.js $three, github.com/mrdoob/three.js"
  cat "$tools/node_modules/three/LICENSE"
  echo "*/"
} > "$tools/banner.txt"
"$tools/node_modules/.bin/esbuild" "$tools/three_parts.js" --bundle --minify --format=esm --legal-comments=none \
  "--banner:js=$(cat "$tools/banner.txt")" "--outfile=$web/three.min.js" --log-level=warning
if [ "${1:-}" = "--update" ]; then
  (cd "$web" && sha256sum three.min.js > three.sha256)
fi
(cd "$web" && sha256sum --check three.sha256)
