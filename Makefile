# `make up` runs the product on this machine; `make test` runs its tests. Each installs what it needs.
# Settings: docs/reference/configuration.md.

PYTHON ?= python3
BIN := .venv/bin
# Without stored bytecode each program compiles its packages again, and the tests start several hundred programs.
unexport PYTHONDONTWRITEBYTECODE
# The machine's Node.js if it is new enough, else the one from a Python wheel.
NODE_READY = command -v npm >/dev/null && node -e 'process.exit(parseInt(process.versions.node) >= 20 ? 0 : 1)'
NODE = PATH="$$({ $(NODE_READY); } 2>/dev/null || printf %s '$(CURDIR)/$(BIN):')$$PATH" npm
NPM = $(NODE) --prefix web

PIP_OPTIONS := --quiet --disable-pip-version-check --no-deps --require-hashes
PIP := $(BIN)/python -m pip install $(PIP_OPTIONS)
# $(call install,requirements,python): uv takes a seventh of pip's processor time. It does not read pip's configuration, so
# pip installs if uv cannot, for example from an index that only pip knows.
install = { $(BIN)/uv pip install --quiet --python $(2) --no-deps --require-hashes -r $(1) 2>/dev/null || \
	$(BIN)/python -m pip --python $(2) install $(PIP_OPTIONS) -r $(1); }
PYTEST := tests/mounted-root $(BIN)/python -m pytest
# Excludes suites at full size and samples expensive families; the sample depends on the commit.
SEED ?= $(shell git rev-parse --short HEAD 2>/dev/null || echo 0)
SAMPLE = $(PYTEST) -q -m "not long" --sample $(SEED)
SECONDS_EACH ?= 60
# Many tests wait for child processes, so four workers share two cores. The tests of one file stay in one worker.
PARALLEL = -n 4 --dist loadfile --no-loadscope-reorder
# Two workers: two browsers and two products use two cores fully.
BROWSERS = -n 2 --dist loadscope tests/e2e
# These tests measure or record a moving robot, or need a response within a deadline, so they run one at a time.
SERIAL = tests/api tests/faults tests/security/tenants/test_secrets.py tests/e2e/operate/test_recorded_session.py \
	tests/e2e/rooms/test_recorded_cameras.py
IGNORE_SERIAL = $(SERIAL:%=--ignore %)

.PHONY: docs help up link env console test test-fast test-long bench bench-quick soak coverage fuzz mutation check check-python check-web audit-packages contract requirements \
	system-packages test-environment wheels agent-bundle clean
.DELETE_ON_ERROR:

help:
	@echo "make up              run Telescope on this machine"
	@echo "make link            print a new one-time sign-in link"
	@echo "make test            run all checks and tests (CI runs the same)"
	@echo "make test-fast       run the fast unit tests"
	@echo "make test-long       run every test suite at full size"
	@echo "make check           linters, types, import rules, generated files, unsafe code, committed secrets"
	@echo "make coverage        unit tests of the agent; every branch of its runtime must be covered"
	@echo "make bench           run all benchmarks, which takes several hours; writes benchmarks/results and docs/results"
	@echo "make bench-quick     run all benchmarks with fewer samples, in about ten minutes"
	@echo "make soak            run the simulated laboratory under load for SOAK_HOURS (8); checks memory, descriptors and errors"
	@echo "make fuzz            run each parser under a fuzzer for SECONDS_EACH (60) seconds"
	@echo "make mutation        test mutants of authority, control, actions and delivery; writes docs/results/mutation.md"
	@echo "make wheels          build the distributions telescope-agent and telescope-server into dist/"
	@echo "make agent-bundle    build the offline bundle of the agent for PLATFORM (linux_x86_64, linux_aarch64) and PYTHON_VERSION (3.11)"
	@echo "make contract        regenerate the AsyncAPI document, the script API and the console's message types"
	@echo "make requirements    regenerate requirements.txt and requirements/*.txt"
	@echo "make audit-packages  query osv.dev for advisories against the pinned packages (needs a network)"
	@echo "make docs            build the documentation site in site/"
	@echo "make clean           remove the environment and all build output"

up: env console
	@exec $(BIN)/python -m infra.local

link: env
	@$(BIN)/python -m infra.local.sign_in_link

env: .venv/.local

.venv/.python:
	@$(PYTHON) -c 'import sys; sys.exit("Telescope needs Python 3.11 or newer; set PYTHON=...") if sys.version_info < (3, 11) else None'
	@$(PYTHON) -m venv .venv || { echo "telescope: python3-venv is missing; install it (Debian: apt-get install python3-venv)" >&2; exit 1; }
	@$(PIP) -r requirements/uv.txt
	@touch $@

.venv/.local: requirements/local.txt | .venv/.python
	@echo "telescope: installing Python packages" >&2
	@$(call install,requirements/local.txt,$(BIN)/python)
	@touch $@

.venv/.dev: requirements/dev.txt | .venv/.python
	@echo "telescope: installing Python packages for development" >&2
	@$(call install,requirements/dev.txt,$(BIN)/python)
	@touch $@ .venv/.local

.venv/.bench: requirements/bench.txt | .venv/.dev
	@echo "telescope: installing Python packages for benchmarks" >&2
	@$(call install,requirements/bench.txt,$(BIN)/python)
	@touch $@

.venv/.mutation: requirements/mutation.txt | .venv/.dev
	@echo "telescope: installing Python packages for mutation testing" >&2
	@$(call install,requirements/mutation.txt,$(BIN)/python)
	@touch $@

.venv/.docs: requirements/docs.txt | .venv/.local
	@echo "telescope: installing Python packages for the documentation site" >&2
	@$(call install,requirements/docs.txt,$(BIN)/python)
	@touch $@

.venv/.node: requirements/node.txt | .venv/.python
	@{ $(NODE_READY); } 2>/dev/null || { echo "telescope: installing Node.js" >&2; \
		$(call install,requirements/node.txt,$(BIN)/python); }
	@touch $@

web/node_modules/.installed: web/package-lock.json | .venv/.node
	@echo "telescope: installing console packages" >&2
	@$(NPM) ci --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

docs/build/node_modules/.installed: docs/build/package-lock.json | .venv/.node
	@echo "telescope: installing browser packages for the documentation site" >&2
	@$(NODE) --prefix docs/build ci --ignore-scripts --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

tests/harness/azurite/node_modules/.installed: tests/harness/azurite/package-lock.json | .venv/.node
	@echo "telescope: installing Azurite" >&2
	@$(NODE) --prefix tests/harness/azurite ci --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

tests/harness/identity_provider/node_modules/.installed: tests/harness/identity_provider/package-lock.json | .venv/.node
	@echo "telescope: installing an OpenID Connect provider" >&2
	@$(NODE) --prefix tests/harness/identity_provider ci --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

# The Functions worker declares Python 3.13 but runs on every version that Telescope supports.
.venv/.azure-worker: requirements/azure-worker.txt | .venv/.dev
	@rm -rf .venv/azure-worker
	@$(PIP) --ignore-requires-python --target .venv/azure-worker -r requirements/azure-worker.txt
	@touch $@

# NAOqi's library has its own interpreter, as at a robot.
.venv/.naoqi: requirements/naoqi.txt | .venv/.python
	@$(PYTHON) -m venv --without-pip --clear .venv/naoqi
	@$(call install,requirements/naoqi.txt,.venv/naoqi/bin/python)
	@touch $@

# LeRobot has its own interpreter too. Some of its packages are built from source.
.venv/.lerobot: requirements/lerobot.txt | .venv/.python
	@$(PYTHON) -m venv --without-pip --clear .venv/lerobot
	@$(call install,requirements/lerobot.txt,.venv/lerobot/bin/python)
	@touch $@

# The newest LeRobot needs Python 3.12 or 3.13. A machine without them tests only the other version, and no datasets.
# `lerobot-dataset` has its loader of datasets with PyTorch, 1.6 GB.
.venv/.lerobot-new: requirements/lerobot-new.txt
.venv/.lerobot-dataset: tests/contract/exports/requirements.txt
.venv/.lerobot-new .venv/.lerobot-dataset: .venv/.%: | .venv/.python
	@rm -rf .venv/$*
	@for python in $(PYTHON) python3.13 python3.12 $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.1[23].*/bin/python; do \
		$$python -c 'import sys; sys.exit(not (3, 12) <= sys.version_info < (3, 14))' 2>/dev/null || continue; \
		$$python -m venv --without-pip .venv/$* || exit; \
		$(call install,$<,.venv/$*/bin/python); exit; \
	done; echo "telescope: no Python 3.12 or 3.13, so $* is not tested" >&2
	@touch $@

# Rerun, 520 MB, for one long test. The packages that it needs are in the environment.
.venv/.rerun: tests/contract/exports/rerun.txt | .venv/.dev
	@rm -rf .venv/rerun
	@$(PIP) --target .venv/rerun -r tests/contract/exports/rerun.txt
	@touch $@

console: web/dist/index.html

web/dist/index.html: web/node_modules/.installed web/index.html web/package.json $(wildcard web/*.ts web/public/*) $(shell find web/src -type f 2>/dev/null)
	@echo "telescope: building the console" >&2
	@$(NPM) run --silent build -- --logLevel warn
	@touch $@

docs: .venv/.docs docs/build/node_modules/.installed
	@NO_MKDOCS_2_WARNING=1 PYTHONPATH=. $(BIN)/mkdocs build --quiet --strict

# System packages come first: a missing program is reported in one line before any test runs.
system-packages:
	@tests/system-packages

# Python packages and console packages install at the same time.
test-environment: system-packages
	@$(MAKE) --no-print-directory -j 3 test-packages

test-packages: .venv/.dev console tests/harness/azurite/node_modules/.installed tests/harness/identity_provider/node_modules/.installed \
	.venv/.azure-worker .venv/.naoqi .venv/.lerobot .venv/.lerobot-new

test: test-environment
	@$(MAKE) --no-print-directory -j 2 check-python check-web
	@$(MAKE) --no-print-directory coverage
	@$(SAMPLE) $(PARALLEL) --ignore tests/unit/device_agent --ignore tests/e2e $(IGNORE_SERIAL)
	@$(SAMPLE) $(BROWSERS) $(IGNORE_SERIAL)
	@$(SAMPLE) $(SERIAL)

# Rules of the agent and the server without brokers, databases, browsers and physics.
test-fast: .venv/.dev
	@$(PYTEST) -q -m "not long and not slow" -n 2 tests/unit

test-long: test-environment .venv/.rerun .venv/.lerobot-dataset check coverage
	@$(PYTEST)

# Every branch of the agent's runtime is covered by the agent's unit tests alone.
coverage: .venv/.dev
	@$(SAMPLE) tests/unit/device_agent $(PARALLEL) --cov=device_agent/runtime --cov-branch \
		--cov-report=term-missing:skip-covered --cov-fail-under=100

bench bench-quick: .venv/.dev .venv/.bench console
	@tests/system-packages
	@$(BIN)/python -m benchmarks $(if $(findstring quick,$@),--quick)

# Ctrl-C ends it with a report.
soak: export SOAK_HOURS ?= 8
soak: .venv/.dev .venv/.bench console
	@tests/system-packages
	@$(BIN)/python -m benchmarks soak

mutation: .venv/.mutation
	@nice -n 15 $(BIN)/python -m tests.harness.mutation --page

fuzz: .venv/.dev
	@$(BIN)/python -m tests.security.fuzz $(SECONDS_EACH)

check: check-python check-web

check-python: .venv/.dev
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --quiet --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/bandit --quiet --recursive --configfile pyproject.toml function_app device_agent infra
	@git ls-files -z | grep -zvE '\.(png|npz)$$' | xargs -0 -n 300 -P 2 $(BIN)/detect-secrets-hook --baseline .secrets.baseline
	@$(BIN)/python requirements/export.py --check
	@$(BIN)/python -m device_agent.protocol.documents.asyncapi | cmp - docs/asyncapi.json || { echo "docs/asyncapi.json is stale; run \`make contract\`" >&2; exit 1; }
	@$(BIN)/python -m device_agent.sandbox.api_document | cmp - device_agent/protocol/documents/script_api.json || { echo "script_api.json is stale; run \`make contract\`" >&2; exit 1; }

check-web: web/node_modules/.installed
	@$(NPM) run --silent check
	@$(NPM) test --silent

contract: .venv/.dev web/node_modules/.installed
	@$(BIN)/python -m device_agent.protocol.documents.asyncapi > docs/asyncapi.json
	@$(BIN)/python -m device_agent.sandbox.api_document > device_agent/protocol/documents/script_api.json.new
	@mv device_agent/protocol/documents/script_api.json.new device_agent/protocol/documents/script_api.json
	@$(NPM) run --silent contract

wheels: .venv/.dev console
	@$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir dist . ./infra/packaging/telescope-agent
	@ls dist/*.whl

# Machine and Python version of the robot.
PLATFORM ?= linux_x86_64
PYTHON_VERSION ?= 3.11
agent-bundle: .venv/.dev
	@nice $(BIN)/python infra/packaging/bundle.py --platform $(PLATFORM) --python $(PYTHON_VERSION) $(if $(WHEELS),--wheels $(WHEELS))

# Separate from `check`, which needs no network. It fails when the database cannot be reached.
audit-packages: .venv/.dev
	@$(BIN)/python requirements/audit.py

requirements: .venv/.dev
	@$(BIN)/python requirements/export.py

clean:
	rm -rf .venv dist site mutants web/node_modules web/dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
