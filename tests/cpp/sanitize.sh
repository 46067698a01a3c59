#!/usr/bin/env bash
# Builds the C++ tests with AddressSanitizer and UndefinedBehaviorSanitizer and runs them: sanitize.sh [cases].
set -euo pipefail
cd "$(dirname "$0")/../.."
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
flags=(-std=c++17 -O1 -g -fopenmp -ffp-contract=off -Wall -Wextra -Icsrc -fsanitize=address,undefined
  -fno-sanitize-recover=all)
objects=()
compile() { # name, flags
  for source in grouped_mlp_isa grouped_mlp_half_isa; do
    "${CXX:-g++}" "${flags[@]}" "${@:2}" -c "csrc/$source.cpp" -o "$build/$source.$1.o" &
    objects+=("$build/$source.$1.o")
  done
}
compile portable -DVN_ISA=0
if [ "$(uname -m)" = x86_64 ]; then
  compile avx2 -DVN_ISA=1 -mavx2 -mfma
  compile avx512 -DVN_ISA=2 -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma
fi
wait
"${CXX:-g++}" "${flags[@]}" csrc/grouped_mlp.cpp csrc/grouped_mlp_plan.cpp csrc/isa.cpp \
  tests/cpp/grouped_mlp_sanitize.cpp "${objects[@]}" -o "$build/run"
"$build/run" "${1:-60}"
