# export-model: make demo shows it work, make test proves it.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
JS := converters/runtimes/javascript/js
TESTS_JS := tests/serve/js
PYTEST := $(BIN)/python -m pytest
# Where the machine forbids it, each of hundreds of processes would compile all modules anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: install browser compiler demo check test lint types docs gallery figures pictures bench fuzz sizes train clean help

help:
	@echo "make install   .venv with every extra, and the locked npm packages"
	@echo "make demo      two trained policies in four formats, compared in every runtime, with a report to look at"
	@echo "make check     lint, types and the tests that start no runtime: two minutes, for the daily loop"
	@echo "make test      lint, types and all tests (installs Chromium, gcc and Mono where apt-get can)"
	@echo "make docs      the documentation as a site in build/docs"
	@echo "make gallery   five trained policies that act in a browser, as a static folder in build/gallery"
	@echo "make figures   docs/figures.md anew, from ../shared (minutes), docs/support-tables.md"
	@echo "make pictures  the pictures of the page and of a report in docs/pictures, anew, from Chromium (minutes)"
	@echo "make sizes     code lines of each room beside what it may have, and what was added since REV=…"
	@echo "make bench     speed, memory and size beside what a user would run instead"
	@echo "make fuzz      damaged files of every kind, N=20000 of each (hours); what came of them, counted"
	@echo "make train     the policies of fixtures/trained anew, in an environment of its own (minutes)"

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt $(JS)/package-lock.json $(TESTS_JS)/package-lock.json
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -c "import tomllib; groups = tomllib.load(open('pyproject.toml', 'rb'))['dependency-groups']; print(*sum(groups.values(), []), sep='\n')" > $(VENV)/groups.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt --requirement $(VENV)/groups.txt --editable '.[all,openvino]'
	$(BIN)/python -m compileall -q -q -j 0 $(VENV)/lib || true # as pip does, on all processors; a template is no program
	cd $(JS) && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
	cd $(TESTS_JS) && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
	@touch $(STAMP)

# Without them the tests in a browser, and those of C and C#, are skipped, so a Debian machine that may install them does.
APT := apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends
# $(1): commands of which one is enough; $(2): Debian's packages; $(3): what is skipped without
define needed
	@for name in $(1); do if command -v "$$name" >/dev/null; then exit 0; fi; done; \
	if ! command -v apt-get >/dev/null; then echo "none of $(1) here: $(3) will be skipped"; \
	elif [ "$$(id -u)" = 0 ]; then $(APT) $(2) >/dev/null; \
	elif command -v sudo >/dev/null; then sudo sh -c '$(APT) $(2) >/dev/null'; \
	else echo "none of $(1) here, and no right to install it: $(3) will be skipped"; fi
endef
browser:
	$(call needed,"$$EXPORT_MODEL_CHROMIUM" chromium chromium-browser google-chrome google-chrome-stable,chromium,the tests in a browser)
compiler: browser # one apt-get at a time
	$(call needed,gcc clang,gcc libc6-dev,the tests of C headers)
	$(call needed,mcs,mono-mcs mono-runtime,the tests of C# classes)

# The first is a folder that training left, the second has an LSTM memory, which every runtime is fed back.
OUT := exported
demo: install
	$(BIN)/export-model fixtures/trained/3DBall fixtures/recurrent.bytes -o $(OUT) --html $(OUT)/parity.html
	@echo
	@echo "To look at:"
	@echo "  $(OUT)/parity.html                           the comparison, in any browser"
	@echo "  $(BIN)/export-model serve $(OUT)/3DBall    a page on which the policy balances the ball"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.audit
	$(BIN)/python -m tests.sizes

# What each room has beside what it may have, and what was added since REV (the last tag).
sizes: install
	$(BIN)/python -m tests.sizes $(REV)

types: install
	$(BIN)/mypy

DAILY := not (runtimes or slow or corpus or legacy or browser or peers)
check: lint types
	EXPORT_MODEL_TEST_DAILY=1 $(PYTEST) -n 2 --dist worksteal -q -m "$(DAILY)"

test: install
	$(MAKE) --jobs 2 browser compiler lint types # one fetches, the others compute
	$(PYTEST) -n 2 --dist loadgroup --cov --cov-report=term:skip-covered --cov-fail-under=90 --durations=25

# Five policies of fixtures/trained as a static folder: a file for each, and an index.
gallery: install
	$(BIN)/export-model $(addprefix fixtures/trained/,3DBall GridWorld Hallway Tennis Crawler2D) -o build/policies --to bytes,tfjs --verify tensorflow
	$(BIN)/export-model serve build/policies -o build/gallery

docs: install
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs build/docs
	@echo "build/docs/index.html"

figures: install
	$(BIN)/python -m tests.figures
	$(BIN)/python -m tests.consumers
	$(BIN)/python -m tests.operators

pictures: install browser
	$(BIN)/python -m tests.pictures

bench: install
	$(BIN)/python -m tests.bench
	$(BIN)/python -m tests.bench.latency
	$(BIN)/python -m tests.bench.litert
	$(BIN)/python -m tests.bench.programs
	$(BIN)/python -m tests.bench.robots
	$(BIN)/python -m tests.bench.verification
	$(BIN)/python -m tests.bench.layouts
	$(BIN)/python -m tests.bench.play
	$(BIN)/python -m tests.bench.throughput --write
	$(BIN)/python -m tests.bench.big

# A mutant has a number and is the same every time: python -m tests.fuzz --reader ONNX --keep 1234 writes it.
N := 20000
fuzz: install
	$(BIN)/python -m tests.fuzz --count $(N)
	$(BIN)/python -m tests.fuzz.differential
	$(BIN)/python -m tests.hostile.contracts
	$(BIN)/python -m tests.hostile.kills
	EXPORT_MODEL_TEST_ANEW=1 $(PYTEST) -n 2 --dist worksteal -q -m "$(DAILY)"

train: install .venv-train/.installed
	OMP_NUM_THREADS=1 PYTHONPATH=. .venv-train/bin/python -m fixtures.train
	$(BIN)/python -m fixtures.trained.write_run
	$(BIN)/python -m fixtures.trained.scores

.venv-train/.installed: fixtures/train/requirements.txt
	$(PYTHON) -m venv .venv-train
	.venv-train/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

clean:
	rm -rf $(VENV) .venv-train exported build .pytest_cache .mypy_cache .ruff_cache .hypothesis
