# Set-up happens by itself: a virtual environment in .venv from requirements.txt, for tests and checks requirements-ci.txt too,
# and the extension built in place, each redone only when its inputs change. PYTHON is the interpreter to start from.
PYTHON ?= python3
PIP_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin

# Parts that must be there, such as REQUIRE=native,warp: their absence fails tests instead of skipping them.
REQUIRE ?=
TEST_ARGS ?=
# Test cases are small: more threads than this wait for each other longer than they work. Some tests ask for their own,
# and wait as they do for `voronerf`, without spinning beside the other processes.
THREADS ?= 1
# Tests start some fifty programs: without bytecode, each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE
# Processes that share the tests.
JOBS ?= auto
# Every architecture nvcc 13 knows that a user may have; the last also as PTX.
CUDA_CHECK_ARCHITECTURES ?= 75 80 86 89 90 100 120

SOURCES := $(shell find csrc -type f) setup.py pyproject.toml

PAPER_ARGS ?= --out runs/paper-small --budget 16 --downscale 8 --rays 512 --samples 48 --evaluations 6 --eval-views 4 --final-views 10

.PHONY: demo wheel test test-all bench paper docs check cuda-check warp-check arm-check isa-check gpu-check gpu-prebuilt emulate-cuda sanitize attack clean

demo: $(VENV)/.built
	@$(BIN)/voronerf demo

# A wheel for this machine and this Python, in dist; a test installs it in a new environment.
wheel: $(VENV)/.wheel

# A few minutes. test-all has the long parts too, which are marked slow.
test: CHOICE := -m "not slow"
test-all: $(VENV)/.wheel
test test-all: $(VENV)/.built
	@OMP_NUM_THREADS=$(THREADS) OMP_WAIT_POLICY=passive $(BIN)/pytest -q -n $(JOBS) --dist worksteal $(CHOICE) $(if $(REQUIRE),--require $(REQUIRE)) $(TEST_ARGS)

# A few minutes; for figures to keep, run the scripts with --json and the settings they document.
bench: $(VENV)/.built
	@$(BIN)/python benchmarks/throughput.py --quick
	@$(BIN)/python benchmarks/time_to_quality.py --data builtin --budget 30 --eval-views 5

# Every table and figure of the paper in small, on Lego and Ship where they are, into runs/paper-small; its report.md has all of them.
# What is there already is not made again.
paper: $(VENV)/.built
	@$(BIN)/python benchmarks/paper.py $(PAPER_ARGS)

check: $(VENV)/.built
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy
	@$(BIN)/clang-format --dry-run --Werror $$(find csrc -type f)
	@$(BIN)/pytest -q tests/test_layers.py tests/test_prose.py

# The documentation with every option and the API reference: open build/site/index.html. Warnings are errors.
docs: $(VENV)/.built $(VENV)/.docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

cuda-check: $(VENV)/.built
	@$(BIN)/python .ci/cuda_check.py $(CUDA_CHECK_ARCHITECTURES)

# The Warp kernels as machine code for the same GPUs, by Warp alone: registers, stack and shared memory. HALF=--half: for 16-bit weights.
warp-check: $(VENV)/.built $(VENV)/.tools
	@$(BIN)/python .ci/warp_check.py $(CUDA_CHECK_ARCHITECTURES) $(HALF)

# The C++ of the CPU kernels on 64-bit Arm, in qemu, with CASES random programs of each kind and calls: needs g++-aarch64-linux-gnu and qemu-user.
CASES ?= 12
arm-check: $(VENV)/.built
	@tests/cpp/arm.sh $(CASES)

# The operations with the instruction sets that this processor would not choose; of graphs these know nothing.
ISAS ?= portable avx2
isa-check: $(addprefix isa-check-,$(ISAS))
isa-check-%: $(VENV)/.built
	@VORONERF_ISA=$* OMP_NUM_THREADS=1 $(BIN)/pytest -q -n $(JOBS) -p no:cacheprovider tests/ops \
	    -k "native-cpu and not compiles and not opcheck"

# Everything to be learnt from fifteen minutes of a GPU, in two calls: CALL=first and second. OUT is a folder for the two
# files that a call leaves; GPU_CHECK_ARGS=--emulated tries it without a GPU. There it links what gpu-prebuilt has
# compiled here for one architecture, where build/prebuilt is carried, and compiles otherwise.
OUT ?= build/gpu-check
CALL ?= first
ARCHITECTURE ?= 90
gpu-check:
	@$(PYTHON) benchmarks/gpu/gpu_check.py $(CALL) --out $(OUT) $(GPU_CHECK_ARGS)
gpu-prebuilt: $(VENV)/.installed
	@$(BIN)/python benchmarks/gpu/prebuilt.py make build/prebuilt $(ARCHITECTURE)

# The tests of the operations on CUDA kernels that run on the CPU, threads in several orders.
emulate-cuda: $(VENV)/.built
	@for seed in 1 2 3; do OMP_NUM_THREADS=1 $(BIN)/pytest -q tests/ops -k native-cpu --emulate-cuda $$seed || exit 1; done

# The C++ of the CPU kernels under AddressSanitizer, UndefinedBehaviorSanitizer and ThreadSanitizer, with random inputs,
# and random calls of the operations with the extension under AddressSanitizer.
sanitize: $(VENV)/.built
	@tests/cpp/sanitize.sh
	@tests/cpp/sanitize_calls.sh

# Random calls of the operations, kills, damaged checkpoints and strangers' files, for about an hour. ATTACK_ARGS names
# parts, seeds and counts: tests/attack --help.
attack: $(VENV)/.built
	@OMP_NUM_THREADS=1 $(BIN)/python tests/attack $(ATTACK_ARGS)

clean:
	rm -rf $(VENV) build dist *.egg-info voronerf/ops/_core/_C.* .mypy_cache .pytest_cache .ruff_cache

# What is more than `make demo` needs: Warp, pycolmap, viser, mypy, a browser's driver, ...
test test-all bench paper check docs emulate-cuda sanitize attack $(addprefix isa-check-,$(ISAS)): $(VENV)/.tools

$(VENV)/.installed: requirements.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_ARGS) -r requirements.txt
	@touch $@

$(VENV)/.tools: requirements-ci.txt $(VENV)/.installed
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_ARGS) -r requirements-ci.txt
	@touch $@

$(VENV)/.docs: requirements-docs.txt $(VENV)/.tools
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_ARGS) -r requirements-docs.txt
	@touch $@

# What an earlier build left in build/lib would go into the wheel.
$(VENV)/.wheel: $(VENV)/.built $(shell find voronerf kernels -name '*.py') $(wildcard voronerf/app/web/*)
	@rm -rf build/lib build/lib.* dist/voronerf-*.whl
	@$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-build-isolation --no-deps --wheel-dir dist .
	@touch $@

$(VENV)/.built: $(VENV)/.installed $(SOURCES)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	@touch $@
