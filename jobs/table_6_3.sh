#!/usr/bin/env bash
# The paper's Table 6.3 on the shipped brain, with the paper's rows beside ours: some 40 s, goes on where it was stopped.
# Writes out/table_6_3/; what jobs/studies/ keeps of it is the same bit for bit, but for the times. JOBS cases at once.
set -euo pipefail
cd "$(dirname "$0")/.."
. jobs/environment.sh
mpitled sweep jobs/brain_tumour.toml --vary tumour.volume=113.1,523.6,1436.8,2144.6,4188.8 \
    --set solver.method=dynamic-relaxation --beside jobs/data/paper_table_6_3.csv --jobs "${JOBS:-1}" --out out/table_6_3
mkdir -p jobs/studies
for name in table.csv times.csv table.md quantities.png; do cp "out/table_6_3/$name" "jobs/studies/6_3_$name"; done
