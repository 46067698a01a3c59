#!/usr/bin/env bash
# Builds the C++ tests of every operation but the whole networks' twice, with AddressSanitizer and UndefinedBehaviorSanitizer
# and with ThreadSanitizer (teams on std::thread, csrc/common/parallel.h), and runs them: sanitize_ops.sh [cases].
set -euo pipefail
cd "$(dirname "$0")/../.."
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
common=(-std=c++17 -O1 -g -ffp-contract=off -Wall -Wextra -Icsrc)
plain=(nearest_centre centre_grid locate_cell cell_sort composite encode spherical_harmonics resample grouped_linear row_tasks isa)
per_isa=(nearest_centre_isa centre_grid_isa composite_isa encode_isa
  spherical_harmonics_isa grouped_linear_isa grouped_linear_half_isa)
isas=("portable -DVN_ISA=0")
if [ "$(uname -m)" = x86_64 ]; then
  isas+=("avx2 -DVN_ISA=1 -mavx2 -mfma" "avx512 -DVN_ISA=2 -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma")
fi

check() { # name, cases, flags
  local name=$1 cases=$2 objects=() jobs=()
  shift 2
  for source in "${plain[@]}"; do
    jobs+=("$(find csrc -name "$source.cpp" -not -path "*/bindings/*") $build/$source.$name.o")
    objects+=("$build/$source.$name.o")
  done
  jobs+=("tests/cpp/ops_sanitize.cpp $build/test.$name.o")
  objects+=("$build/test.$name.o")
  for source in "${per_isa[@]}"; do
    for isa in "${isas[@]}"; do
      jobs+=("$(find csrc -name "$source.cpp" -not -path "*/bindings/*") $build/$source.${isa%% *}.$name.o ${isa#* }")
      objects+=("$build/$source.${isa%% *}.$name.o")
    done
  done
  # Each line: source, object, flags of its own.
  printf '%s\n' "${jobs[@]}" |
    xargs -P "$(nproc)" -L 1 sh -c 'source=$1 object=$2; shift 2; '"${CXX:-g++} ${common[*]} $*"' "$@" -c "$source" -o "$object"' sh
  "${CXX:-g++}" "$@" "${objects[@]}" -o "$build/$name"
  echo -n "$name: "
  "$build/$name" "$cases"
}

check address-and-undefined "${1:-40}" -fopenmp -fsanitize=address,undefined -fno-sanitize-recover=all
export TSAN_OPTIONS="halt_on_error=1 ${TSAN_OPTIONS:-}"
check thread "${1:-16}" -DVN_STD_THREADS -pthread -fsanitize=thread
