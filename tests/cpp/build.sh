#!/usr/bin/env bash
# Builds the C++ tests of CPU kernels (ops and programs) with $CXX (g++) for its architecture: build.sh FOLDER FLAGS...
set -euo pipefail
folder=$1
shift
cd "$(dirname "$0")/../.."
read -ra cxx <<<"${CXX:-g++}"
isas=("portable -DVN_ISA=0") # as in setup.py
case $("${cxx[@]}" -dumpmachine) in
  x86_64-*) isas+=("avx2 -DVN_ISA=1 -mavx2 -mfma" "avx512 -DVN_ISA=2 -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma") ;;
  aarch64-* | arm64-*) isas+=("neon -DVN_ISA=3") ;;
esac
mkdir -p "$folder"
# Each line has a source, its object, and flags for this source only.
for source in tests/cpp/*.cpp $(find csrc -name "*.cpp" -not -path "*/bindings/*" -not -path "*/cuda/*"); do
  object=$folder/$(basename "$source" .cpp)
  if [[ $source == *_isa.cpp ]]; then
    for isa in "${isas[@]}"; do echo "$source $object.${isa%% *}.o ${isa#* }"; done
  else
    echo "$source $object.o"
  fi
done | xargs -P "$(nproc)" -L 1 sh -c 'source=$1 object=$2; shift 2; exec '"${cxx[*]} -std=c++17 -ffp-contract=off -Wall \
  -Wextra -Wno-unknown-pragmas -Wno-unused-parameter -Icsrc $*"' "$@" -c "$source" -o "$object"' sh
for test in ops programs; do
  read -ra others <<<"$(echo "$folder"/*.o | tr ' ' '\n' | grep -v -e /ops.o -e /programs.o | tr '\n' ' ')"
  "${cxx[@]}" "$@" "$folder/$test.o" "${others[@]}" -o "$folder/$test"
done
