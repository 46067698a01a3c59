#!/usr/bin/env bash
# Builds the C++ tests with sanitizers and runs them: sanitize.sh [cases] [first case]. AddressSanitizer and
# UndefinedBehaviorSanitizer come first, then ThreadSanitizer. The latter runs with teams of std::thread
# (csrc/common/parallel.h), since it would report the barriers of an uninstrumented OpenMP runtime as races.
set -euo pipefail
here=$(dirname "$0")
first=${2:-0} # for other programs
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
export TSAN_OPTIONS="halt_on_error=1 ${TSAN_OPTIONS:-}"

check() { # name, cases, flags
  "$here/build.sh" "$build/$1" -O1 -g "${@:3}"
  for test in ops programs; do
    echo -n "$test, $1: "
    setarch -R "$build/$1/$test" "$2" "$build/drawn" "$first" # gaps between mappings may be too random for ThreadSanitizer's shadow
  done
}

"$here/../../.venv/bin/python" "$here/programs.py" "${1:-40}" "$build/drawn" "$first"
check address-and-undefined "${1:-40}" -fopenmp -fsanitize=address,undefined -fno-sanitize-recover=all
check thread "$((${1:-40} / 3))" -DVN_STD_THREADS -pthread -fsanitize=thread
