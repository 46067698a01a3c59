#!/usr/bin/env bash
# Builds the extension with AddressSanitizer beside the installed one, and runs random valid and invalid calls of the
# operations with this build: sanitize_calls.sh [calls of each kind]. The next build compiles all files again, since both
# builds keep their objects in build/.
set -euo pipefail
cd "$(dirname "$0")/../.."
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
VORONERF_CUDA=0 CXXFLAGS="-fsanitize=address -O1 -fno-omit-frame-pointer" \
  .venv/bin/python setup.py -q build --build-lib "$build/lib" --build-temp "$build/objects"
library() { ${CXX:-g++} -print-file-name="$1"; }
# Preloads libstdc++ too, since AddressSanitizer looks up the functions that throw exceptions when the process starts.
# Some calls ask for more memory than there is, which torch's allocator must be able to refuse.
export ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1
LD_PRELOAD="$(library libasan.so) $(library libstdc++.so)" OMP_NUM_THREADS=1 PYTHONPATH=$build/lib \
  .venv/bin/python tests/attack valid-calls invalid-calls --count "${1:-12600}"
