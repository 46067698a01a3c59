#!/usr/bin/env bash
# Builds the C++ tests with sanitizers and runs them: sanitize.sh [cases]. First AddressSanitizer and
# UndefinedBehaviorSanitizer, then ThreadSanitizer, for which teams are of std::thread (csrc/common/parallel.h): it takes the
# barriers of an OpenMP runtime that was built without it for races.
set -euo pipefail
cd "$(dirname "$0")/../.."
cases=${1:-60}
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT

isas=("portable -DVN_ISA=0")
if [ "$(uname -m)" = x86_64 ]; then
  isas+=("avx2 -DVN_ISA=1 -mavx2 -mfma"
    "avx512 -DVN_ISA=2 -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma")
fi

# Name, flags of the sanitizer, the test and its sources (those named *_isa once for each instruction set), cases.
check() {
  local name=$1 sanitizer=$2 sources=$3 count=$4 objects=() jobs=() source isa job
  local flags=(-std=c++17 -O1 -g -ffp-contract=off -Wall -Wextra -Icsrc -fno-sanitize-recover=all)
  # shellcheck disable=SC2206
  flags+=($sanitizer)
  mkdir "$build/$name"
  for source in $sources; do
    local sets=("any")
    [[ $source == *_isa ]] && sets=("${isas[@]}")
    for isa in "${sets[@]}"; do
      objects+=("$build/$name/$(basename "$source").${isa%% *}.o")
      # shellcheck disable=SC2086
      "${CXX:-g++}" "${flags[@]}" $([ "$isa" = any ] || echo ${isa#* }) -c "$source.cpp" -o "${objects[-1]}" &
      jobs+=($!)
    done
  done
  for job in "${jobs[@]}"; do wait "$job"; done
  "${CXX:-g++}" "${flags[@]}" "${objects[@]}" -o "$build/$name/run"
  echo "$name: $sanitizer"
  # Gaps between mappings may be too random for ThreadSanitizer's shadow.
  setarch -R "$build/$name/run" "$count"
}

mlp="csrc/network/cpu/grouped_mlp_isa csrc/network/cpu/grouped_mlp_half_isa csrc/network/cpu/grouped_mlp csrc/encoding/hash_encode csrc/encoding/hash_encode_isa csrc/network/cpu/grouped_mlp_plan csrc/network/cpu/row_tasks csrc/common/isa
  tests/cpp/grouped_mlp_sanitize"
check grouped_mlp "-fsanitize=address,undefined -fopenmp" "$mlp" "$cases"
check grouped_mlp_threads "-fsanitize=thread -DVN_STD_THREADS" "$mlp" "$((cases / 3))"
