# Thin names over the programs; `make help` lists them.
.DEFAULT_GOAL := help
BLIMP := .venv/bin/blimp

.PHONY: help setup demo serve test check bench experiments budget hil soak soak-service limits faults fuzz \
  soak-stream fleet install-service uninstall-service image release flash update hil-image lock sample picture virtual-camera

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-18s %s\n", $$1, $$2}' Makefile

setup:  ## Install system packages (root or sudo for these only) and the locked Python environment
	@sh deploy/ground_station/setup.sh

demo: setup  ## Map the sample atrium, stream the sample flight, localize it live: out/demo/report.html
	@$(BLIMP) replay --demo --out out/demo

serve: setup  ## Run the ground station: the sample flight, or MAP=maps/NAME; http://127.0.0.1:8080/
	@$(BLIMP) serve $(if $(MAP),--map $(MAP),--demo)

# How the payload's network is called comes from a person: make expands nothing in it.
unexport DEVICE IMAGE WIFI COUNTRY
flash: export FLASH_DEVICE := $(value DEVICE)
flash: export FLASH_IMAGE := $(value IMAGE)
flash: export FLASH_PAYLOAD := $(value PAYLOAD)
flash: export FLASH_WIFI := $(value WIFI)
flash: export FLASH_COUNTRY := $(value COUNTRY)

image: setup  ## Build a card (root or sudo): BOARD=zero2w|qemu, BOARD=zerow BASE=raspios.img.xz
	@sh deploy/packages.sh deploy/image/apt-packages.txt
	@$$([ "$$(id -u)" = 0 ] || echo sudo) .venv/bin/python -m deploy.image \
	  --board "$(or $(BOARD),zero2w)" $(if $(BASE),--base "$(BASE)") $(OPTIONS)

release: setup  ## Compress, sign and list an image for others: IMAGE=FILE URL=https://WHERE/IT/WILL/BE
	@.venv/bin/python -m deploy.publish "$(IMAGE)" --url "$(URL)" $(OPTIONS)

flash: setup  ## Write a card: DEVICE=/dev/sdX IMAGE=FILE PAYLOAD=blimp-1 WIFI=SSID|FILE.toml COUNTRY=DE
	@case "$$FLASH_WIFI" in *.toml) wifi=--wifi ;; *) wifi=--wifi-ssid ;; esac; \
	sudo=; [ -b "$$FLASH_DEVICE" ] && [ ! -w "$$FLASH_DEVICE" ] && sudo=sudo; \
	$$sudo .venv/bin/python -m deploy.flash --device "$$FLASH_DEVICE" --image "$$FLASH_IMAGE" \
	  --payload "$$FLASH_PAYLOAD" $${FLASH_WIFI:+"$$wifi=$$FLASH_WIFI"} \
	  $${FLASH_COUNTRY:+--country "$$FLASH_COUNTRY"} $(OPTIONS)

update: setup  ## Send this checkout's firmware to a payload: PAYLOAD=blimp-1 [HOST=ADDRESS]
	@.venv/bin/python -m deploy.update --payload "$(PAYLOAD)" $(if $(HOST),--host "$(HOST)") $(OPTIONS)

hil-image: setup  ## Boot the qemu card in an emulated Pi: stream, cut its power, update it (root)
	@sh deploy/packages.sh deploy/image/apt-packages.txt
	@.venv/bin/python -m pytest -q -s tests/hil/image/whole_card.py

install-service: setup  ## Install the ground station as a hardened system service (root or sudo)
	@sh deploy/ground_station/service.sh install

uninstall-service:  ## Take the service away; configuration and recordings stay
	@sh deploy/ground_station/service.sh uninstall

# In the order that tests/conftest.py makes.
SPREAD = --dist loadfile --no-loadscope-reorder

# Bytecode of their own asserts is what the phases' eight processes would else make eight times.
test: export PYTHONDONTWRITEBYTECODE :=

test: setup  ## Run the tests of every room
	@sh tests/tools.sh
	@failed=0; \
	.venv/bin/python -m pytest -q -m beside -n auto $(SPREAD) tests || failed=1; \
	.venv/bin/python -m pytest -q -m "not beside and not alone" -n 3 $(SPREAD) tests || failed=1; \
	.venv/bin/python -m pytest -q -m alone tests || failed=1; \
	exit $$failed

check: setup  ## Lint, formatting, types, and which room may import which
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy -n auto
	@.venv/bin/lint-imports --no-cache

hil: setup  ## Replay tests: PAYLOAD=process|image|ssh:user@host[:port] CASES="loss outage"
	@if [ "$(PAYLOAD)" = image ]; then \
	  sh deploy/packages.sh deploy/image/apt-packages.txt && sh tests/hil/image/tools.sh; fi
	@.venv/bin/python tests/hil/suite.py $(CASES) --payload "$(or $(PAYLOAD),process)" $(OPTIONS)

bench: setup  ## Measure localizer, payload and features: costs in ratios of one run, and errors
	@mkdir -p out
	@$(BLIMP) bench localize --json out/bench.json
	@$(BLIMP) bench payload --json out/bench-payload.json
	@$(BLIMP) bench features --json out/bench-features.json

experiments: setup  ## The thesis's experiments and more: NAMES="motion fast", OPTIONS=--quick
	@$(BLIMP) experiments $(NAMES) --out out/experiments $(OPTIONS)

budget: setup  ## Compute the default build's budget: table and plots in out/budget; status 1 without margin
	@.venv/bin/python -m hw budget --out out/budget

soak: setup  ## Fly the firmware HOURS=0.5 over a lossy link: leaks, latency, clock, every frame accounted for
	@mkdir -p out
	@.venv/bin/python tests/faults/soak.py --hours "$(or $(HOURS),0.5)" --loss 0.02 --out out/soak.json

faults: setup  ## Faults across payload and ground: roaming, the matrix and 15 walks (OPTIONS=--long)
	@mkdir -p out/faults
	@.venv/bin/python tests/faults/scenarios/run.py matrix --keep out/faults --out out/faults/matrix.json
	@.venv/bin/python tests/faults/scenarios/run.py walks --keep out/faults --out out/faults/walks.json $(OPTIONS)
	@.venv/bin/python -m pytest -q tests/faults/roaming.py

fuzz: setup  ## Fuzz what reads from outside, SECONDS=120 a reader: READERS="rtp maps"
	@.venv/bin/python tests/fuzz/run.py $(READERS) --seconds "$(or $(SECONDS),120)"

limits: setup  ## Search what loss, delay, bit rate, CPU and payloads the system bears: ONLY=loss,rate
	@mkdir -p out
	@.venv/bin/python tests/hil/limits.py --out out/limits.json $(if $(ONLY),--only "$(ONLY)") $(OPTIONS)

sample: setup  ## Make the shipped sample of maps/atrium again, from its fixed seeds (about 10 minutes)
	@$(BLIMP) simulate --sample maps/atrium
	@$(BLIMP) map build maps/atrium/mapping.mcap --settings maps/atrium/mapping.toml --out maps/atrium
	@$(BLIMP) map register maps/atrium --pairs maps/atrium/PAIRS.csv
	@$(BLIMP) map export maps/atrium --png maps/atrium/map.png

picture: setup  ## Make README's picture of the dashboard again, with the system's Chromium
	@.venv/bin/python tests/service/dashboard_picture.py maps/atrium/dashboard.jpg

virtual-camera: setup  ## A Debian 13 in out/ with libcamera's virtual camera, for its tests (as root)
	@sh tests/pi_firmware/virtual_camera/setup.sh

soak-service: setup  ## The same for the whole service, HOURS=1, with a payload that comes and goes
	@mkdir -p out
	@.venv/bin/python tests/service/soak.py --hours "$(or $(HOURS),1)" --out out/soak-service.json

soak-stream: setup  ## One unbroken stream of HOURS=1 through the live localizer, as fast as it takes it
	@mkdir -p out
	@.venv/bin/python tests/service/soak_stream.py --hours "$(or $(HOURS),1)" --out out/soak-stream.json

fleet: setup  ## What payloads and the page cost on 1, 3 and 6 stations; how soon one takes over
	@mkdir -p out
	@.venv/bin/python tests/service/fleet_growth.py --out out/fleet.json

lock:  ## Resolve requirements.lock again from pyproject.toml
	@mkdir -p out && python3 -m venv out/lock && out/lock/bin/pip install -q uv
	@out/lock/bin/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url \
	  --no-header --no-annotate --python-version 3.11 --extra dev pyproject.toml -o requirements.lock
