# Each target runs in an environment that scripts/run makes: ROS 2 where it is installed, otherwise .venv.

.DEFAULT_GOAL := help
.PHONY: help demo test bench study bags readme lint clean

help: ## this list
	@sed -n 's/^\([a-z]*\): ## \(.*\)/  make \1\t\2/p' Makefile | expand -t 16

demo: ## a flight and a turntable through both nodes over DDS, scored; writes build/demo/report.html
	@scripts/run study attitude_demo

test: ## the whole test suite
	@scripts/run study,test python3 -m pytest --numprocesses 2 --dist loadfile $(ARGS)

bench: ## cost of a sample and of a message, beside other filters
	@scripts/run study,bench python3 -m studies.bench

study: ## rewrite the tables of docs/results
	@scripts/run study python3 -m studies.recordings
	@scripts/run study python3 -m studies.choice
	@scripts/run study python3 -m studies.attitude
	@scripts/run study python3 -m studies.real_effects
	@scripts/run study,bench python3 -m studies.other_motions
	@scripts/run study python3 -m studies.north_finding
	@scripts/run study python3 -m studies.ins_alignment
	@scripts/run study python3 -m studies.disturbances
	@scripts/run study python3 -m studies.strapdown
	@scripts/run study python3 -m studies.helicopter
	@scripts/run study python3 -m studies.two_filters

bags: ## rewrite the bundled bags, byte for byte the same
	@scripts/run study scripts/make_bags bags

readme: ## rewrite the parameter tables of README.md
	@scripts/run study python3 scripts/write_readme_tables

lint: ## ruff
	@scripts/run study,test ruff check

clean: ## remove everything that was made, .venv too
	rm -rf .venv build install log ./*.egg-info .pytest_cache .ruff_cache
