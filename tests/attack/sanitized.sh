#!/usr/bin/env bash
# Random calls of the operations under AddressSanitizer: sanitized.sh [calls]. Builds the extension a second time, in build/sanitized.
set -euo pipefail
cd "$(dirname "$0")/../.."
python=${PYTHON:-.venv/bin/python}
count=${1:-5000}
flags="-O1 -g -fno-omit-frame-pointer -fsanitize=address"
VORONERF_CUDA=0 CXX="${CXX:-g++}" CXXFLAGS="$flags" LDFLAGS=-fsanitize=address \
  "$python" setup.py -q build --build-base build/sanitized --build-lib build/sanitized/lib
# In a process that was not built with it, the sanitizer's library comes first. Python's own memory is never given back.
LD_PRELOAD="$("${CXX:-g++}" -print-file-name=libasan.so)" ASAN_OPTIONS=detect_leaks=0 PYTHONPATH=build/sanitized/lib OMP_NUM_THREADS=1 \
  "$python" tests/attack valid-calls invalid-calls --count "$((count / 2))"
