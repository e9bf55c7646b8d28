# Every target does the set-up it needs first: system libraries, .venv, pinned requirements, ourselves.
PYTHON := .venv/bin/python
SHARED ?= ../shared
.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow test-gige test-v4l2 test-landmarks check bench clean

help: ## this list
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-15s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## install what is missing; seconds when nothing is
	@sh tools/setup.sh

demo: setup ## a simulated 16-camera session through every stage, and its report
	@.venv/bin/likeness demo --out demo

check: setup ## ruff, mypy and import-linter
	@$(PYTHON) -m tools.check

test: setup check ## checks and every test but the slow ones
	@$(PYTHON) -m pytest -m "not slow and not gpu and not hardware and not landmarks and not gige and not v4l2"

test-slow: setup ## the tests that take more than a minute
	@$(PYTHON) -m pytest -m "slow"

test-gige: setup ## real Aravis against sixteen fake GigE Vision devices and one of our own; wants root
	@sh tools/setup_gige.sh || echo "test-gige: goes on with what is there; a test that lacks something says so" >&2
	@$(PYTHON) -m pytest -rs -m "gige" tests/gige

test-v4l2: setup ## the kernel's vivid driver in a QEMU guest
	@sh tools/setup_v4l2.sh
	@$(PYTHON) -m pytest -rs -m "v4l2" tests/v4l2

test-landmarks: setup ## the 68-point detector on the simulated actor; read docs/licences.md first
	@$(PYTHON) -m pip install --quiet --disable-pip-version-check "face_recognition_models==0.3.0"
	@$(PYTHON) -m pytest -m "landmarks"

bench: setup ## every benchmark; those on real takes want the folder SHARED
	$(PYTHON) -m tools.bench.bench_actor
	$(PYTHON) -m tools.bench.bench_calibrate protocol opponents images --small --seeds 2
	$(PYTHON) -m tools.bench.capture
	$(PYTHON) -m tools.bench.rig speed --shared $(SHARED)
	$(PYTHON) -m tools.bench.bench_neutral
	$(PYTHON) -m tools.bench.bench_landmarks $(SHARED)/takes/dev-smile --frames 0 3 6 11
	$(PYTHON) -m tools.bench.bench_stereo $(SHARED)/takes/dev-smile 0 --score $(SHARED)/tools/score_scan.py
	$(PYTHON) -m tools.bench.bench_track $(SHARED)/takes/dev-smile --score $(SHARED)/tools/score_track.py \
		--cases default opponent --faults ""
	$(PYTHON) -m tools.bench.bench_flow $(SHARED)/takes/dev-smile --frames 3 6
	$(PYTHON) -m tools.bench.bench_spine $(SHARED)/takes/dev-smile --shared $(SHARED)

clean: ## remove the environment and what the demo wrote
	rm -rf .venv demo build *.egg-info
