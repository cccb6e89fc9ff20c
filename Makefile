# Two commands: `make up` runs the product on this machine, `make test` passes its tests. Each sets itself up.
# Ports, folder and broker: TELESCOPE_PORT, TELESCOPE_HOME, TELESCOPE_BROKER (see README).

PYTHON ?= python3
BIN := .venv/bin
# Node.js of the machine when it is new enough, else the one that comes as a Python wheel.
NODE_READY = command -v npm >/dev/null && node -e 'process.exit(parseInt(process.versions.node) >= 20 ? 0 : 1)'
NODE = PATH="$(if $(wildcard $(BIN)/npm),$(CURDIR)/$(BIN):)$$PATH" npm
NPM = $(NODE) --prefix web

SECONDS_EACH ?= 60
# Most tests wait for processes of their own, so three run side by side on two cores; a file's tests stay together.
SIDE_BY_SIDE = -n 3 --dist loadfile --no-loadscope-reorder
# Two browsers and two products fill two cores: a worker has the laboratory, the other one all that needs one arm or less.
BROWSERS = -n 2 --dist loadscope tests/e2e
# Those run one at a time that have a robot in motion before them, or an answer that must come in time.
ALONE = tests/api tests/faults tests/security/tenants/test_secrets.py

.PHONY: help up link env console test test-long bench bench-quick coverage fuzz check audit-packages contract requirements clean
.DELETE_ON_ERROR:

help:
	@echo "make up            run Telescope on this machine"
	@echo "make link          print another one-time sign-in link"
	@echo "make test          check and test everything (about twenty-five minutes on two cores: see CONTRIBUTING.md for where it goes)"
	@echo "make test-long     the same with every suite at full size"
	@echo "make bench         what users feel, measured, with an hour of load: benchmarks/results, docs/results/benchmarks.md"
	@echo "make bench-quick   the same with fewer samples, in some minutes"
	@echo "make coverage      every branch of the agent's runtime, by its unit tests alone"
	@echo "make fuzz          each parser under a fuzzer, SECONDS_EACH=60"
	@echo "make check         linters, types, import contracts, generated files, unsafe code, committed secrets"
	@echo "make audit-packages  ask osv.dev what is known against the pinned packages (needs a network)"
	@echo "make contract      regenerate docs/asyncapi.json, protocol/script_api.json and web/src/shared/mqtt/protocol.generated.ts"
	@echo "make requirements  regenerate requirements.txt and requirements/*.txt"

up: env console
	@exec $(BIN)/python -m infra.local

link: env
	@$(BIN)/python -m infra.local.sign_in_link

env: .venv/.local

.venv/.python:
	@$(PYTHON) -c 'import sys; sys.exit("Telescope needs Python 3.11 or newer; set PYTHON=...") if sys.version_info < (3, 11) else None'
	@$(PYTHON) -m venv .venv || { echo "telescope: python3-venv is missing; install it (Debian: apt-get install python3-venv)" >&2; exit 1; }
	@touch $@

.venv/.local: requirements/local.txt | .venv/.python
	@echo "telescope: installing Python packages" >&2
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements/local.txt
	@touch $@

.venv/.dev: requirements/dev.txt | .venv/.python
	@echo "telescope: installing Python packages for development" >&2
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements/dev.txt
	@touch $@ .venv/.local

.venv/.bench: requirements/bench.txt | .venv/.dev
	@echo "telescope: installing Python packages for benchmarks" >&2
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements/bench.txt
	@touch $@

.venv/.node: requirements/node.txt | .venv/.python
	@{ $(NODE_READY); } 2>/dev/null || { echo "telescope: installing Node.js" >&2; \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements/node.txt; }
	@touch $@

web/node_modules/.installed: web/package-lock.json | .venv/.node
	@echo "telescope: installing console packages" >&2
	@$(NPM) ci --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

tests/harness/azurite/node_modules/.installed: tests/harness/azurite/package-lock.json | .venv/.node
	@echo "telescope: installing Azurite" >&2
	@$(NODE) --prefix tests/harness/azurite ci --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

tests/harness/identity_provider/node_modules/.installed: tests/harness/identity_provider/package-lock.json | .venv/.node
	@echo "telescope: installing an OpenID Connect provider" >&2
	@$(NODE) --prefix tests/harness/identity_provider ci --loglevel error --no-fund --no-audit >/dev/null
	@touch $@

# The Functions worker runs on every Python that Telescope does, though it asks for 3.13.
.venv/.azure-worker: requirements/azure-worker.txt | .venv/.dev
	@rm -rf .venv/azure-worker
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --ignore-requires-python \
		--target .venv/azure-worker -r requirements/azure-worker.txt
	@touch $@

console: web/dist/index.html

web/dist/index.html: web/node_modules/.installed web/index.html web/package.json $(wildcard web/*.ts web/public/*) $(shell find web/src -type f 2>/dev/null)
	@echo "telescope: building the console" >&2
	@$(NPM) run --silent build -- --logLevel warn
	@touch $@

# The agent's unit tests run once: where their coverage is counted.
test: .venv/.dev console check tests/harness/azurite/node_modules/.installed tests/harness/identity_provider/node_modules/.installed .venv/.azure-worker coverage
	@tests/system-packages
	@$(NPM) test --silent
	@tests/twice -m "not long" $(SIDE_BY_SIDE) --ignore tests/unit/device_agent --ignore tests/e2e $(ALONE:%=--ignore %)
	@tests/twice -m "not long" $(BROWSERS)
	@tests/twice -m "not long" $(ALONE)

test-long: .venv/.dev console check tests/harness/azurite/node_modules/.installed tests/harness/identity_provider/node_modules/.installed .venv/.azure-worker coverage
	@tests/system-packages
	@$(NPM) test --silent
	@$(BIN)/python -m pytest

coverage: .venv/.dev
	@tests/twice -q tests/unit/device_agent -m "not long" $(SIDE_BY_SIDE) --cov=device_agent/runtime --cov-branch \
		--cov-report=term-missing:skip-covered --cov-fail-under=100

bench bench-quick: .venv/.dev .venv/.bench console
	@tests/system-packages
	@$(BIN)/python -m benchmarks $(if $(findstring quick,$@),--quick)

fuzz: .venv/.dev
	@$(BIN)/python -m tests.security.fuzz $(SECONDS_EACH)

check: .venv/.dev web/node_modules/.installed
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/bandit --quiet --recursive --configfile pyproject.toml function_app device_agent infra
	@git ls-files -z | grep -zvE '\.(png|npz)$$' | xargs -0 -n 300 -P 2 $(BIN)/detect-secrets-hook --baseline .secrets.baseline
	@$(BIN)/python requirements/export.py --check
	@$(BIN)/python -m device_agent.protocol.documents.asyncapi | cmp - docs/asyncapi.json || { echo "docs/asyncapi.json is stale; run \`make contract\`" >&2; exit 1; }
	@$(BIN)/python -m device_agent.sandbox.api_document | cmp - device_agent/protocol/documents/script_api.json || { echo "script_api.json is stale; run \`make contract\`" >&2; exit 1; }
	@$(NPM) run --silent check

contract: .venv/.dev web/node_modules/.installed
	@$(BIN)/python -m device_agent.protocol.documents.asyncapi > docs/asyncapi.json
	@$(BIN)/python -m device_agent.sandbox.api_document > device_agent/protocol/documents/script_api.json.new
	@mv device_agent/protocol/documents/script_api.json.new device_agent/protocol/documents/script_api.json
	@$(NPM) run --silent contract

# Apart from `check`, which needs no network. It says so where it could not ask, and is not green then.
audit-packages: .venv/.dev
	@$(BIN)/python requirements/audit.py

requirements: .venv/.dev
	@$(BIN)/python requirements/export.py

clean:
	rm -rf .venv web/node_modules web/dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
