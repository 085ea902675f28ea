#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Build the environment .venv of a user without ROS 2; does nothing when nothing has changed.
# VENV names another folder for it, PINS a file whose pins replace those of tools/requirements.txt,
# SOURCES packages that are built from their source archives.
set -euo pipefail
cd "$(dirname "$0")/.."
venv="$PWD/${VENV:-.venv}"
build="build${VENV:+/${VENV#.}}"
pins="${PINS:-/dev/null}"
die() { echo "setup: $*" >&2; exit 2; }
[[ "$PWD" != *[\'\"\$=,\;:\\]* ]] || die "ROS's build tools do not work in $PWD, because of a quote or one of \$ = , ; : \\ in its path; move the clone elsewhere"

suitable() {  # runs, and is a version for which the ROS 2 wheels exist and the code is written
  "$1" -c 'import sys, venv, ensurepip; sys.exit(not (3, 12) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

find_python() {
  local candidate
  for candidate in "${PYTHON:-}" python3.12 "${HOME:-}"/.pyenv/versions/3.12.*/bin/python \
                   python3.13 "${HOME:-}"/.pyenv/versions/3.13.*/bin/python python3; do
    if [ -n "$candidate" ] && suitable "$candidate"; then echo "$candidate"; return; fi
  done
  return 1
}

digest() { cat "$@" | sha256sum | cut -d' ' -f1; }
fresh() { [ -f "$venv/.stamp-$1" ] && [ "$(cat "$venv/.stamp-$1")" = "$2" ]; }
stamp() { echo "$2" > "$venv/.stamp-$1"; }
log="$PWD/$build/setup.log"
mkdir -p "$build"
step() {  # say what is done; show the log only when it fails
  echo "setup: $1"; shift
  if ! "$@" >> "$log" 2>&1; then
    tail -n 40 "$log" >&2
    die "failed; the whole log is in $build/setup.log"
  fi
}

replaced() {  # the pins of tools/requirements.txt, those of $pins in place of theirs
  awk -F== '/^#/ {next} NR == FNR {own[$1] = $0; next} !($1 in own); END {for (name in own) print own[name]}' \
    "$pins" tools/requirements.txt
}

install_pins() {  # by four pips at once: each spends half its time on the network, and has one core
  rm -f "$build"/pins.*
  replaced | split -n r/4 - "$build/pins."
  printf '%s\n' "$build"/pins.* | xargs -P 4 -n 1 "$venv/bin/python" -m pip install -qq \
    --disable-pip-version-check --no-deps --no-compile --require-hashes --only-binary :all: \
    --no-binary "empy${SOURCES:+,$SOURCES}" -r
}

compile() {  # what is no Python 3, as templates, and what nothing imports is passed over
  "$venv/bin/python" -m compileall -q -j 0 -x '/(tests?|templates?|mypyc?|docutils)/' "$@" || true
}

wheels=$(digest tools/requirements.txt "$pins" tools/mend_wheels.py)
if ! fresh wheels "$wheels"; then
  : > "$log"
  [ "$(uname -sm)" = "Linux x86_64" ] || die "the ROS 2 wheels are for Linux on x86_64; on other machines use a ROS 2 Jazzy installation and colcon (README)"
  command -v g++ > /dev/null || die "no C++ compiler; install one, e.g. 'apt install build-essential'"
  if ! { [ -x "$venv/bin/python" ] && suitable "$venv/bin/python"; }; then
    python=$(find_python) || die "no Python 3.12 or 3.13 with venv; install one, e.g. 'apt install python3.12 python3.12-venv python3.12-dev', or set PYTHON to its path"
    rm -rf "$venv"
    step "creating ${venv##*/} with $("$python" --version)" "$python" -m venv "$venv"
  fi
  include=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
  [ -f "$include/Python.h" ] || die "Python.h is missing; install the headers, e.g. 'apt install python3.12-dev'"
  step "installing the pinned wheels (about half a minute)" install_pins
  step "mending the wheels' CMake paths" "$venv/bin/python" tools/mend_wheels.py
  # here and on both cores: else every process that may not write bytecode compiles all it imports
  step "compiling them" compile "$venv/lib"
  numpy=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/numpy
  [ -d "$numpy/_core/include" ] || ln -s ../core/include "$numpy/_core/include"  # NumPy 1; the wheels name 2's
  rm -f "$venv/.stamp-messages"
  stamp wheels "$wheels"
fi

messages=$(find msg_defs -type f | LC_ALL=C sort | xargs sha256sum | sha256sum | cut -d' ' -f1)
if ! fresh messages "$messages"; then
  scratch=$(mktemp -d)  # rosidl reads no path with letters beyond ASCII
  trap 'rm -rf "$scratch"' EXIT
  cp -r msg_defs "$scratch"
  # -j in MAKEFLAGS: else colcon has ninja wait while the load is high, and everything is serial
  step "building selfcal_msgs" env PATH="$venv/bin:$PATH" LD_LIBRARY_PATH="$venv/lib" \
    MAKEFLAGS="-j$(nproc)" \
    AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv" \
    "$venv/bin/colcon" --log-base "$build/colcon_log" build --base-paths "$scratch/msg_defs" \
    --build-base "$scratch/build" --merge-install --install-base "$venv" \
    --cmake-args -G Ninja -DBUILD_TESTING=OFF -DPYTHON_ONLY=ON \
    "-DPython3_EXECUTABLE=$venv/bin/python" --no-warn-unused-cli
  stamp messages "$messages"
fi

package=$( { cat setup.py setup.cfg package.xml; find launch config resource -type f | LC_ALL=C sort | xargs sha256sum; } | sha256sum | cut -d' ' -f1)
if ! fresh package "$package"; then
  step "installing selfcal_ros" "$venv/bin/python" -m pip install --disable-pip-version-check \
    --no-deps --no-build-isolation --config-settings editable_mode=compat --editable .
  step "installing its share files" "$venv/bin/python" tools/install_share.py "$venv"
  step "compiling it" compile selfcal_ros "$venv/lib/"python3.*/site-packages/*_msgs
  stamp package "$package"
fi
