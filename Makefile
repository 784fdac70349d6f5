# Each command works from a clean clone and makes its own virtual environment in .venv. What is imported there is compiled
# once: a process that may not write it down would compile NumPy, SciPy and Matplotlib anew.
export PYTHONDONTWRITEBYTECODE :=

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NATIVE := build/native
SOURCES := pyproject.toml CMakeLists.txt README.md $(shell find core binding -type f) \
  $(shell find src -name '*.py' -o -name '*.pyi' -o -name '*.jinja' -o -name '*.json')
CXX_FILES := $(shell find core binding tests/native benchmarks -name '*.hpp' -o -name '*.cpp')
# What `make stubs` makes, and `make lint` compares. The stub of the binding is made by each build.
STUBS := _base/method_names.pyi _problem/accepted.pyi _solve/ode_functions.pyi scipy.pyi
PIP := $(BIN)/python -m pip -q --disable-pip-version-check
CTEST := $(BIN)/ctest --output-on-failure -j 2 --timeout 600
WHEEL := build/wheel
CMAKE := $(BIN)/cmake -G Ninja -DINVARIODE_PYTHON=OFF -DINVARIODE_NATIVE_TESTS=ON -DINVARIODE_WERROR=ON \
  -DPython_EXECUTABLE=$(abspath $(BIN)/python) -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN)/ninja)

# Other compilers and processors; what is not installed is skipped, with a message.
CLANG ?= clang++
AARCH64 ?= aarch64-linux-gnu
LOWEST := .venv-lowest

.PHONY: paper test test-lowest test-newer test-threads test-jax test-torch test-kernels native native-clang native-aarch64 sanitize sanitize-threads metadata fuzz fuzz-sanitize lint analyze format stubs bench docs dist \
  wheel requirements clean

paper: $(VENV)/.installed-paper  ## the paper's experiments: a table, and paper-report.html
	$(BIN)/python -m paper --output paper-report.html

# Each worker starts with a third of the files, and takes over from the others at the end: what tests of one file share,
# such as compiled functions, is made once. Three for two cores: some tests wait, for a signal, a process or a disk.
# Without the plugins of other packages: at each start pytest would import, and rewrite, all of Zarr and of hypothesis.
# What a dependency deprecates is shown to users, and an error in CI only.
PYTEST := -m pytest -q -p xdist.plugin -p no:logging -n 3 --dist worksteal \
  $(if $(CI),-W error::DeprecationWarning -W error::PendingDeprecationWarning)
test test-lowest test-kernels: export PYTEST_DISABLE_PLUGIN_AUTOLOAD := 1

# The extra whose requirements are installed while the package is built.
WITH := test
paper: WITH := paper
docs: WITH := docs
test-threads: WITH :=

test: $(VENV)/.installed-test native  ## every test: the core's own, then Python's
	$(BIN)/python $(PYTEST)

test-lowest: $(LOWEST)/.installed  ## the Python tests with every dependency at its lowest allowed version
	$(LOWEST)/bin/python $(PYTEST) -W ignore::DeprecationWarning

test-newer: $(VENV)/.installed-test  ## the Python tests on newer interpreters, as far as this machine has them
	.ci/newer

test-jax: $(VENV)/.installed-test-jax  ## the tests of invariode.jax
	$(BIN)/python -m pytest -q tests/test_jax.py

test-torch: $(VENV)/.installed-test-torch  ## the tests of invariode.torch; PyTorch takes several gigabytes where it comes with CUDA
	$(BIN)/python -m pytest -q tests/test_torch.py

# Tests that need no extra, and share nothing but the package and its problems.
THREAD_TESTS := $(patsubst %,tests/test_%.py,counts callbacks events projection dense order)

test-threads: $(WHEEL)/.built  ## these tests, each on four threads at once; meant for a CPython without the lock, such as 3.14t
	$(PIP) install pytest hypothesis pytest-run-parallel
	$(BIN)/python -m pytest -q --parallel-threads=4 $(THREAD_TESTS)

# Of OpenBLAS, that this processor can run: tests that find their way from one rounding error to the next.
KERNEL_TESTS := tests/test_kernels.py tests/test_stiff.py -k "chosen or null_space or put_back or ends_of_the_test_set"
# Tests that compare with numbers, with the elementary functions that NumPy has for the oldest processors.
BASELINE_TESTS := $(patsubst %,tests/test_%.py,paper counts nystrom order guard)

test-kernels: $(VENV)/.installed-test  ## the stiff tests with the linear algebra of other processors, and counts with NumPy's oldest loops
	set -e; for kernel in $$($(BIN)/python tests/kernels.py); do echo $$kernel; \
	  OPENBLAS_CORETYPE=$$kernel $(BIN)/python $(PYTEST) $(KERNEL_TESTS); done
	NPY_DISABLE_CPU_FEATURES="$$($(BIN)/python tests/kernels.py features)" $(BIN)/python $(PYTEST) $(BASELINE_TESTS)

# With the core of the wheel, which pip has just built.
native: $(VENV)/.installed-test
	$(CMAKE) -S . -B $(NATIVE) -DINVARIODE_CORE_LIBRARY=$$(ls -t $(CURDIR)/build/cp*/libinvariode_core.a | head -n 1)
	$(BIN)/cmake --build $(NATIVE)
	$(CTEST) --test-dir $(NATIVE)

# $(call native_with,NAME,OPTIONS): the native tests in a build directory of their own.
define native_with
	$(CMAKE) -S . -B $(NATIVE)-$(1) -DINVARIODE_ASSERT=ON $(2)
	$(BIN)/cmake --build $(NATIVE)-$(1)
	$(CTEST) --test-dir $(NATIVE)-$(1)
endef

ifeq ($(shell command -v $(CLANG)),)
native-clang:
	@echo "native-clang skipped: there is no $(CLANG) here; on Debian, apt-get install clang"
else
native-clang: $(VENV)/.installed-test  ## the core's tests, compiled by clang
	$(call native_with,clang,-DCMAKE_CXX_COMPILER=$(CLANG))
endif

ifeq ($(and $(shell command -v $(AARCH64)-g++),$(shell command -v qemu-aarch64)),)
native-aarch64:
	@echo "native-aarch64 skipped: on Debian, apt-get install g++-aarch64-linux-gnu qemu-user"
else
native-aarch64: $(VENV)/.installed-test  ## the core's tests, cross-compiled for 64-bit ARM and emulated
	$(call native_with,aarch64,-DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
	  -DCMAKE_CXX_COMPILER=$(AARCH64)-g++ "-DCMAKE_CROSSCOMPILING_EMULATOR=qemu-aarch64;-L;/usr/$(AARCH64)")
endif

# Line tables are what the reports need of -g; -O1 keeps them, and runs the tests several times as fast.
SANITIZED_FLAGS := -DCMAKE_BUILD_TYPE=Debug "-DCMAKE_CXX_FLAGS_DEBUG=-g1 -O1"

sanitize: $(VENV)/.installed-test  ## the core's tests under ASan and UBSan
	$(CMAKE) -S . -B $(NATIVE)-sanitize $(SANITIZED_FLAGS) -DINVARIODE_SANITIZE=address,undefined
	$(BIN)/cmake --build $(NATIVE)-sanitize
	$(CTEST) --test-dir $(NATIVE)-sanitize

sanitize-threads: $(VENV)/.installed-test  ## the tests of runs and ensembles on threads under TSan
	$(CMAKE) -S . -B $(NATIVE)-threads $(SANITIZED_FLAGS) -DINVARIODE_SANITIZE=thread
	$(BIN)/cmake --build $(NATIVE)-threads --target native_threads
	$(CTEST) --test-dir $(NATIVE)-threads -R '^native_(threads|run|ensemble|lanes)$$'

# So many random cases of each kind; `make fuzz N=100000 SEED=7`.
N := 10000
SEED := 1
FUZZ := tests/fuzz/campaign.py --cases $(N) --seed $(SEED)
SANITIZED := build/sanitized

fuzz: $(VENV)/.installed-test  ## random calls, runs and files: nothing may crash, hang, mislead or be wrong
	$(BIN)/python $(FUZZ)

fuzz-sanitize: $(VENV)/.installed-test  ## the same with the extension built under ASan and UBSan (gcc)
	rm -rf $(SANITIZED)
	$(PIP) install --no-deps --target $(SANITIZED) \
	  -C cmake.build-type=Debug -C cmake.define.INVARIODE_SANITIZE=address,undefined .
	LD_PRELOAD="$(foreach lib,asan ubsan stdc++,$(shell gcc -print-file-name=lib$(lib).so))" PYTHONMALLOC=malloc \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONPATH=$(SANITIZED) $(BIN)/python $(FUZZ)

# $(call tidy,UNITY,CHECKS): clang-tidy with .clang-tidy's checks changed by CHECKS, over what is compiled of the core. With
# UNITY=ON the headers that the files of a folder share are read once; with OFF every file by itself, which also shows
# that it includes what it uses. A name there may shadow that of another file, so `analyze` looks for shadowed ones.
define tidy
	$(CMAKE) -S . -B $(NATIVE)-lint -DINVARIODE_UNITY=$(1)
	$(BIN)/python -c 'import json; [print(one["file"]) for one in json.load(open("$(NATIVE)-lint/compile_commands.json")) \
	  if "invariode_core.dir" in one["output"]]' | xargs -P 2 -n 1 $(BIN)/clang-tidy -quiet -p $(NATIVE)-lint $(2)
endef

lint: $(VENV)/.installed-lint  ## style, types, docstrings, static analysis, drift of the generated stubs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	cd build && ../$(BIN)/python -m nanobind.stubgen -q -m invariode._core -o ../src/invariode/_core.pyi
	$(BIN)/mypy
	$(BIN)/mypy --config-file tests/typing/mypy.ini tests/typing
	$(BIN)/python docs/docstrings.py
	$(BIN)/clang-format --dry-run -Werror $(CXX_FILES)
	$(call tidy,ON,"--checks=-clang-analyzer-*" --extra-arg=-Wno-shadow)
	mkdir -p build/_base build/_problem build/_solve
	$(BIN)/python .ci/stubs.py build
	for stub in $(STUBS); do diff build/$$stub src/invariode/$$stub || exit 1; done

analyze: $(VENV)/.installed-lint  ## clang's static analyser over each file of the core; once a day
	$(call tidy,OFF,"--checks=-*$(comma)clang-analyzer-*$(comma)-clang-analyzer-unix.Malloc$(comma)-clang-analyzer-security.ArrayBound$(comma)-clang-analyzer-optin.performance.Padding")

format: $(VENV)/.installed-lint
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/clang-format -i $(CXX_FILES)

stubs: $(VENV)/.installed-lint  ## regenerate the stubs of what the registry of methods and the table of options define
	$(BIN)/python .ci/stubs.py src/invariode

bench: $(VENV)/.installed-bench  ## measure, and write the tables of docs/benchmarks
	$(BIN)/python benchmarks/overhead.py --write
	$(BIN)/python benchmarks/multistep.py --write
	$(BIN)/python benchmarks/implicit.py --write
	$(BIN)/python benchmarks/jacobians.py --write
	$(BIN)/python benchmarks/daes.py --write
	$(BIN)/python benchmarks/valves.py --write
	$(BIN)/python benchmarks/work.py --write
	$(BIN)/python benchmarks/second_order.py --write
	$(BIN)/python benchmarks/long_runs.py --write
	$(BIN)/python benchmarks/precision.py --write
	$(BIN)/python benchmarks/mechanics.py --write
	$(BIN)/python benchmarks/links.py --write
	$(BIN)/python benchmarks/chains.py --write
	$(BIN)/python benchmarks/manifolds.py --write
	$(BIN)/python benchmarks/native.py --write
	$(BIN)/python benchmarks/compiled.py --write
	$(BIN)/python benchmarks/peers.py --write
	$(BIN)/python benchmarks/taylor.py --write
	$(BIN)/python benchmarks/ensembles.py --write
	$(BIN)/python benchmarks/lanes.py --write
	$(BIN)/python benchmarks/many.py --write
	$(BIN)/python benchmarks/large.py --write
	$(BIN)/python benchmarks/detest.py --write
	$(BIN)/python benchmarks/events.py --write
	$(BIN)/python benchmarks/limits.py --write
	$(BIN)/python benchmarks/directions.py --write
	$(BIN)/python benchmarks/fits.py --write
	$(BIN)/python benchmarks/sensitivities.py --write

dist: $(VENV)/bin/python  ## a source distribution, and a wheel that is built from it
	rm -rf dist
	$(PIP) install build twine
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

metadata: $(VENV)/bin/python  ## the workflows, the metadata and the files for publishing
	$(PIP) install check-jsonschema "sp-repo-review[cli]" zizmor
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.dependabot .github/dependabot.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff
	$(BIN)/zizmor --offline .github
	$(BIN)/sp-repo-review .

docs: $(VENV)/.installed-docs  ## the documentation, in build/docs and as Markdown in guide: every cell and example executed, warnings are errors
	$(BIN)/sphinx-build -W --keep-going -b html docs build/docs

clean:
	rm -rf build dist $(VENV) $(LOWEST) paper-report.html docs/gallery docs/generated docs/sg_execution_times.rst

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The package as it is now, built once; meanwhile its requirements are installed, with those of the extra WITH. Warnings
# are errors where nobody but us is bothered by them.
$(WHEEL)/.built: $(VENV)/bin/python $(SOURCES)
	rm -rf $(WHEEL)
	+$(MAKE) -s -j 2 wheel requirements WITH=$(WITH)
	$(PIP) install --force-reinstall --no-deps $(WHEEL)/invariode-*.whl
	@echo $(WITH) > $@

wheel:
	$(PIP) wheel --no-deps -w $(WHEEL) $(if $(CI),--config-settings=cmake.define.INVARIODE_WERROR=ON) .

requirements:
	$(BIN)/python .ci/requirements.py $(WITH) > $(VENV)/requirements.txt
	$(PIP) install --no-compile -r $(VENV)/requirements.txt

# .installed-a-b: that package, with the extras a and b; of these, what is imported is compiled then. The extra WITH came
# with the package.
comma := ,
$(VENV)/.installed-%: $(WHEEL)/.built
	[ "$*" = "$$(cat $<)" ] || $(PIP) install --no-compile "$$(echo $(WHEEL)/invariode-*.whl)[$(subst -,$(comma),$*)]"
	@touch $@

# Built against the lowest build requirements, installed with the lowest requirements; then the tests run from the sources.
$(LOWEST)/.installed: $(SOURCES) tests/lowest.py
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python tests/lowest.py --build > $(LOWEST)/build.txt
	$(LOWEST)/bin/python tests/lowest.py > $(LOWEST)/run.txt
	$(LOWEST)/bin/python -m pip install -q --disable-pip-version-check -r $(LOWEST)/build.txt ninja cmake
	$(LOWEST)/bin/python -m pip wheel -q --disable-pip-version-check --no-deps --no-build-isolation -w $(LOWEST) .
	$(LOWEST)/bin/python -m pip install -q --disable-pip-version-check -r $(LOWEST)/run.txt $(LOWEST)/invariode-*.whl
	@touch $@
