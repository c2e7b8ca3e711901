#!/usr/bin/env bash
# Make sure that Chromium and its driver are there, for tests of pages (`make web-tools`).
# As root on Debian they are installed; elsewhere it says what to install.
set -euo pipefail

browser() {
  command -v chromium || command -v chromium-browser || command -v google-chrome || command -v chrome
}

if ! { browser && command -v chromedriver; } >/dev/null; then
  if command -v apt-get >/dev/null && [ "$(id -u)" -eq 0 ]; then
    echo "Installing chromium, chromium-driver and a font ..."
    apt-get update -qq &&
      DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        chromium chromium-driver fonts-dejavu-core >/dev/null || true
  fi
fi
if ! { browser && command -v chromedriver; } >/dev/null; then
  printf '\nStopped: Chromium and its driver are missing, so pages cannot be tested.\n' >&2
  printf '  On Debian:  sudo apt install chromium chromium-driver\n' >&2
  printf '  Elsewhere:  Chrome or Chromium with the chromedriver of its version, both on the PATH\n' >&2
  exit 1
fi
