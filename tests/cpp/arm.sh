#!/usr/bin/env bash
# Cross-compiles the C++ tests for 64-bit Arm and runs them in qemu: every kernel with NEON against its portable path.
# arm.sh [cases]; needs g++-aarch64-linux-gnu and qemu-user (Debian's names).
set -euo pipefail
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
here=$(dirname "$0")
"$here/../../.venv/bin/python" "$here/programs.py" "${1:-12}" "$build/drawn"
CXX=${CXX:-aarch64-linux-gnu-g++} "$here/build.sh" "$build" -O1 -DVN_STD_THREADS -pthread -static
for test in ops programs; do
  echo -n "$test, aarch64: "
  qemu-aarch64 "$build/$test" "${1:-12}" "$build/drawn"
done
