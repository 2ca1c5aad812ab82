#!/usr/bin/env bash
# Sets up what is missing, then passes the tests: formatting, types, and the suite. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
. jobs/environment.sh
# A browser for the report's page, and what joins two hosts; without root those tests are skipped, and say so.
{ command -v chromium && command -v ip; } >/dev/null || mpitled_apt chromium iproute2 || true
ruff check .
ruff format --check .
mypy
pytest -n auto --dist loadfile "$@" # a file of tests on each core
