#!/usr/bin/env bash
# Builds the extension with AddressSanitizer, apart from the installed one, and makes random calls of the operations with
# it, valid and not: sanitize_calls.sh [calls of each kind].
set -euo pipefail
cd "$(dirname "$0")/../.."
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
VORONERF_CUDA=0 CXXFLAGS="-fsanitize=address -O1 -fno-omit-frame-pointer" \
  .venv/bin/python setup.py -q build --build-lib "$build/lib" --build-temp "$build/objects"
library() { ${CXX:-g++} -print-file-name="$1"; }
# libstdc++ too, since AddressSanitizer looks for the throwing of exceptions when the process starts.
LD_PRELOAD="$(library libasan.so) $(library libstdc++.so)" ASAN_OPTIONS=detect_leaks=0 OMP_NUM_THREADS=1 \
  PYTHONPATH=$build/lib .venv/bin/python tests/attack valid-calls invalid-calls --count "${1:-12600}"
