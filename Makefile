# make sil    close the loop over the simulated bus: runs/raster-lockstep-1/ holds recording, summary and picture
# make live   operate the simulated stage: a page and clients, until Ctrl-C
# make test   run every test, the linter and the type checker; what runs against the machine's clock after all else, alone
# make test-socketcan  controller and plant in two processes over the kernel's CAN sockets, in a guest that has them
# make test-peers  other makers' CANopen stacks and tools over the kernel's CAN sockets, in such a guest
# make test-firmware  a million ticks of the exported controller, here and on an emulated Cortex-M7: the bits of Python?
# make test-page  a headless Chromium, fetched if there is none, drives the page of pkxyz serve
# make bench  measure what the docs promise and print it
# make mutate change one thing at a time in gate, modes, monitors, comb law and codec: does a test notice? SECONDS=1200
# make both-ways  every case of the fault matrix in whole ticks and event by event, under LAWS on BUSES: the same bits?
# make prove  every state that shipped controller and node can reach under any law with up to three faults: EXPLORED="one two"
# make coverage  branches and conditions (MC/DC) of safety, codec, driver, start-up and the node's drive path, met by tests
# make fuzz   hostile frames and broken documents: FRAMES=1000000 DOCUMENTS=10000
# make kills  SIGKILL, SIGSTOP and SIGTERM at random moments, KILLS=300 at rate, KILLS_LOCKSTEP=10000 in lockstep's clock: 0 V in time?
# make docs   draw every figure of docs/ and fill in the generated tables
# make docs-site  build the documentation into site/: open site/index.html
PYTHON ?= python3
BIN := .venv/bin

.PHONY: sil live test test-socketcan test-peers test-firmware test-page bench docs docs-site wheel clean mutate fuzz kills prove coverage both-ways

sil: .venv/.ready
	$(BIN)/pkxyz sil

live: .venv/.ready
	$(BIN)/pkxyz serve

test: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder -m "not at_rate"
	$(BIN)/python -m pytest -m at_rate --reruns 4 --reruns-delay 5

test-socketcan: .venv/.ready
	$(BIN)/python tests/socketcan/run.py

test-peers: .venv/.ready
	$(BIN)/python tests/socketcan/run.py tests/socketcan/on_vcan_peers.py

TICKS ?= 1000000
test-firmware: .venv/.ready
	$(BIN)/python tests/firmware/run.py $(TICKS)

test-page: .venv/.ready
	$(BIN)/python tests/page/run.py --goes 3

bench: .venv/.ready
	$(BIN)/pkxyz bench

SECONDS ?= 1200
mutate: .venv/.ready
	$(BIN)/python tests/mutation/mutate.py --seconds $(SECONDS) --report

LAWS ?= lqg youla
BUSES ?= fd_5k classic_2k unix_1k
both-ways: .venv/.ready
	$(BIN)/python tests/whole_ticks/both_ways.py $(LAWS:%=--law %) $(BUSES:%=--bus %)
	$(BIN)/python tests/whole_ticks/both_ways.py --lasting $(LAWS:%=--law %) $(BUSES:%=--bus %)

prove: .venv/.ready
	$(BIN)/python tests/proof/explore.py $(EXPLORED)

coverage: .venv/.ready
	$(BIN)/python tests/proof/mcdc.py

FRAMES ?= 1000000
DOCUMENTS ?= 10000
fuzz: .venv/.ready
	$(BIN)/python tests/fuzz/fuzz.py --frames $(FRAMES) --documents $(DOCUMENTS)

KILLS ?= 300
KILLS_LOCKSTEP ?= 10000
kills: .venv/.ready
	$(BIN)/python tests/recording/kills_at_rate.py $(KILLS)
	$(BIN)/python tests/recording/kills_lockstep.py $(KILLS_LOCKSTEP)

docs: .venv/.ready
	$(BIN)/python docs/build.py

docs-site: .venv/.ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "Open site/index.html"

wheel: .venv/.ready
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir dist .

# A stamp, so that the environment is built once and again only when what it is built from has changed.
.venv/.ready: pyproject.toml constraints.txt
	@echo "Building the environment in .venv (a minute or two) ..."
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[test,docs]"
	$(BIN)/python -m compileall -q pkxyz_ctrl hil sim
	@touch $@

clean:
	rm -rf .venv dist runs site
