#!/usr/bin/env bash
# Error against run time of a tumour of 523.6 mm3 in the ellipsoid: what the defaults of the cloud and of support domains rest on.
# Some three minutes; goes on where it was stopped. Writes out/study_tumour/study.csv and study.png, kept in jobs/studies/.
set -euo pipefail
. "$(dirname "$0")/../environment.sh"
mpitled study jobs/validation/tumour.toml --reference tests/data/C_tum.npz --set solver.method=dynamic-relaxation \
    --vary cloud.growth=0.15,0.3 --vary cloud.points_per_spacing=1.0,1.4 --vary support.nodes=8,16 \
    --vary support.consistency=false --vary support.stabilisation=0.0,0.03,0.5 --vary tumour.surface_nodes=400,1600 \
    --vary ellipsoid.element_size=4,8 --vary "solver.method=quasi-static,quasi-static+solver.load_time=1,2" \
    --vary support.weight=equal
mkdir -p jobs/studies
cp out/study_tumour/study.csv jobs/studies/tumour.csv
cp out/study_tumour/study.png jobs/studies/tumour.png
