#!/usr/bin/env bash
# Build .venv from requirements.lock: exact versions, every download checked against its hash.
# `make` calls this when .venv is missing or older than the lock. It installs nothing outside .venv,
# says what it does, and where it stops it says why and what to do.
#
#   F3AMD_PYTHON   interpreter to use, such as python3.12; by default the first on the PATH that fits
#   F3AMD_VENV     folder to build; .venv by default
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv="${F3AMD_VENV:-.venv}"
oldest=11 # jax 0.10 needs Python 3.11
newest=14 # the newest for which every package in the lock has a ready-made build

stop() {
  printf '\nStopped: %s\n' "$1" >&2
  shift
  for line in "$@"; do printf '  %s\n' "$line" >&2; done
  exit 1
}

# "3.12" for an interpreter that starts; nothing otherwise.
version_of() {
  "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null || true
}

fits() {
  case "$1" in
    3.*) [ "${1#3.}" -ge "$oldest" ] && [ "${1#3.}" -le "$newest" ] ;;
    *) return 1 ;;
  esac
}

# 1. An interpreter.
if [ -n "${F3AMD_PYTHON:-}" ]; then
  candidates=("$F3AMD_PYTHON")
else
  candidates=(python3 python3.12 python3.13 python3.11 python3.14)
fi
python=""
seen=""
for candidate in "${candidates[@]}"; do
  version="$(version_of "$candidate")"
  if [ -z "$version" ]; then continue; fi
  if fits "$version"; then
    python="$candidate"
    break
  fi
  seen="$seen $candidate is $version;"
done
if [ -z "$python" ]; then
  if [ -n "$seen" ]; then
    stop "Python 3.$oldest to 3.$newest is needed, and${seen%;}." \
      "Debian 12 and newer, Ubuntu 24.04 and newer have a fitting python3." \
      "On Ubuntu 22.04:  sudo apt install python3.11 python3.11-venv" \
      "Then:             make F3AMD_PYTHON=python3.11 test"
  fi
  if [ -n "${F3AMD_PYTHON:-}" ]; then
    stop "F3AMD_PYTHON=$F3AMD_PYTHON does not start a Python." \
      "Give a name on the PATH, such as python3.12, or a full path; or leave it out."
  fi
  stop "there is no Python 3 on the PATH." \
    "On Debian or Ubuntu:  sudo apt install python3 python3-venv"
fi
echo "Using $python (Python $version)."

# 2. Its venv module. Debian and Ubuntu ship it apart, and only ensurepip shows that it is missing.
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
  stop "this Python has no venv module." \
    "On Debian or Ubuntu:  sudo apt install python$version-venv" \
    "(python3-venv for the system's own python3)"
fi

# 3. The environment. One of another Python version cannot be kept.
if [ -e "$venv" ] && [ "$(version_of "$venv/bin/python")" != "$version" ]; then
  if [ ! -f "$venv/pyvenv.cfg" ]; then
    stop "$venv exists and is no virtual environment." "Move it away and start again."
  fi
  if [ ! -f "$venv/installed" ] && [ ! -f "$venv/install.log" ]; then
    stop "$venv is of another Python and was not made by this script." "Move it away and start again."
  fi
  echo "Replacing $venv, which was made for another Python."
  rm -rf "$venv"
fi
if [ ! -x "$venv/bin/pip" ]; then
  echo "Making $venv ..."
  "$python" -m venv "$venv" || stop "$python could not make $venv (see the lines above)."
fi

# 4. The packages.
log="$venv/install.log"
packages="$(grep '^[a-z0-9].*==' requirements.lock | grep -vc 'extra ==')"
echo "Installing up to $packages packages into $venv (some minutes, about 1.4 GB; log: $log) ..."
pip=("$venv/bin/python" -m pip --disable-pip-version-check --no-input)
# The lock is whole (`pip check` below), so nothing is resolved; bytecode is made below, on all cores: half the time.
if ! "${pip[@]}" install --progress-bar off --require-hashes --no-deps --no-compile -r requirements.lock >"$log" 2>&1; then
  grep '^ERROR' "$log" | tail -n 3 | sed 's/^/  | /' >&2 || true
  network='NewConnectionError|NameResolutionError|ConnectTimeoutError|ReadTimeoutError|ProxyError'
  network="$network|SSLError|Connection (broken|aborted|reset)|Network is unreachable|name resolution"
  if grep -q 'DO NOT MATCH THE HASHES' "$log"; then
    stop "a downloaded package is not the one that requirements.lock names." \
      "Nothing of it was installed. A damaged download is cured by trying again;" \
      "if it happens again, something between here and the package index alters files."
  elif grep -q 'No space left on device' "$log"; then
    stop "the disk is full." "The environment needs about 1.4 GB, and downloads 300 MB more."
  elif grep -qE "$network" "$log"; then
    stop "the package index could not be reached: no network for the install?" \
      "The first run downloads about 300 MB; later runs need no network." \
      "Check the connection (or pip's proxy settings) and run make again."
  fi
  stop "pip could not install requirements.lock." "The whole log is in $log."
fi
# Extras that are there already stay whole: some need other versions than the lock's plain part.
for extra in "$venv"/extra-*; do
  if [ -e "$extra" ]; then bash scripts/extra.sh "${extra##*/extra-}" >>"$log" 2>&1 || rm -f "$extra"; fi
done
if ! "${pip[@]}" check >>"$log" 2>&1; then
  tail -n 3 "$log" | sed 's/^/  | /' >&2
  stop "requirements.lock does not fit this Python or machine (see the lines above)." "The whole log is in $log."
fi
# Packages bring files for other Pythons, too, that this one cannot compile: they stay as they are.
"$venv/bin/python" -m compileall -q -j 0 "$venv/lib" >>"$log" 2>&1 || true
# setuptools is in the lock, so that this step downloads nothing.
if ! "${pip[@]}" install --no-deps --no-build-isolation -e . >>"$log" 2>&1; then
  tail -n 6 "$log" | sed 's/^/  | /' >&2
  stop "the package itself could not be installed into $venv." "The whole log is in $log."
fi
touch "$venv/installed"
echo "$venv is ready."
