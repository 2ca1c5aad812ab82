#!/usr/bin/env bash
# Sets up what is missing, then passes the tests: formatting, types, and the suite. Arguments go to pytest.
set -euo pipefail
. "$(dirname "$0")/../jobs/environment.sh"
ruff check .
ruff format --check .
mypy
pytest "$@"
