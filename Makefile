# Each command works from a clean clone and makes its own virtual environment in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NATIVE := build/native
SOURCES := pyproject.toml CMakeLists.txt README.md $(shell find core binding -type f) \
  $(shell find src -name '*.py' -o -name '*.pyi' -o -name '*.jinja' -o -name '*.json')
CXX_FILES := $(shell find core binding tests/native benchmarks -name '*.hpp' -o -name '*.cpp')
# What `make stubs` makes, and `make lint` compares.
STUBS := _core.pyi ode_functions.pyi scipy.pyi
# Warnings are errors where nobody but us is bothered by them.
INSTALL := $(BIN)/python -m pip install -q --disable-pip-version-check $(if $(CI),--config-settings=cmake.define.INVARIODE_WERROR=ON)
CMAKE := $(BIN)/cmake -G Ninja -DINVARIODE_PYTHON=OFF -DINVARIODE_NATIVE_TESTS=ON -DINVARIODE_WERROR=ON \
  -DPython_EXECUTABLE=$(abspath $(BIN)/python) -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN)/ninja)

.PHONY: paper test native sanitize lint format stubs bench docs dist clean

paper: $(VENV)/.installed-cli-plot  ## the paper's experiments: a table, and paper-report.html
	$(BIN)/invariode paper --output paper-report.html

test: $(VENV)/.installed-test native  ## every test: the core's own, then Python's
	$(BIN)/python -m pytest -q

native: $(VENV)/.installed-test
	$(CMAKE) -S . -B $(NATIVE)
	$(BIN)/cmake --build $(NATIVE)
	$(BIN)/ctest --test-dir $(NATIVE) --output-on-failure

sanitize: $(VENV)/.installed-test  ## the core's tests under ASan and UBSan
	$(CMAKE) -S . -B $(NATIVE)-sanitize -DCMAKE_BUILD_TYPE=Debug -DINVARIODE_SANITIZE=address,undefined
	$(BIN)/cmake --build $(NATIVE)-sanitize
	$(BIN)/ctest --test-dir $(NATIVE)-sanitize --output-on-failure

lint: $(VENV)/.installed-lint native  ## style, types, docstrings, static analysis, drift of the generated stubs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python docs/docstrings.py
	$(BIN)/clang-format --dry-run -Werror $(CXX_FILES)
	$(BIN)/clang-tidy -quiet -p $(NATIVE) $(shell find core -name '*.cpp')
	cd build && ../$(BIN)/python -m nanobind.stubgen -q -m invariode._core -o _core.pyi
	$(BIN)/python .ci/stubs.py build
	for stub in $(STUBS); do diff build/$$stub src/invariode/$$stub || exit 1; done

format: $(VENV)/.installed-lint
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/clang-format -i $(CXX_FILES)

stubs: $(VENV)/.installed-lint  ## regenerate the stubs, of the binding and of what the registry of methods defines
	cd build && ../$(BIN)/python -m nanobind.stubgen -q -m invariode._core -o ../src/invariode/_core.pyi
	$(BIN)/python .ci/stubs.py src/invariode

bench: $(VENV)/.installed-bench  ## measure, and write docs/benchmarks.md
	$(BIN)/python benchmarks/overhead.py --write
	$(BIN)/python benchmarks/multistep.py --write
	$(BIN)/python benchmarks/precision.py --write
	$(BIN)/python benchmarks/native.py --write
	$(BIN)/python benchmarks/peers.py --write
	$(BIN)/python benchmarks/ensembles.py --write
	$(BIN)/python benchmarks/large.py --write
	$(BIN)/python benchmarks/detest.py --write

dist: $(VENV)/bin/python  ## a source distribution, and a wheel that is built from it
	rm -rf dist
	$(BIN)/python -m pip install -q --disable-pip-version-check build twine
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

docs: $(VENV)/.installed-docs  ## the documentation, in build/docs: every cell and example executed, warnings are errors
	$(BIN)/sphinx-build -W --keep-going -b html docs build/docs

clean:
	rm -rf build dist $(VENV) paper-report.html docs/gallery docs/generated docs/sg_execution_times.rst

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# .installed-a-b: the package as it is now, with the extras a and b.
comma := ,
$(VENV)/.installed-%: $(VENV)/bin/python $(SOURCES)
	$(INSTALL) ".[$(subst -,$(comma),$*)]"
	@touch $@
