#!/usr/bin/env bash
# Error against run time of a tumour of 523.6 mm3 in the ellipsoid: what the defaults of the cloud and of support domains rest on.
# Some three minutes; goes on where it was stopped. Writes out/study_tumour/study.csv and study.png, kept in jobs/studies/.
set -euo pipefail
cd "$(dirname "$0")/../.."
. jobs/environment.sh
mpitled study jobs/validation/tumour.toml --reference tests/data/C_tum.npz \
    --vary cloud.growth=0.15,0.3 --vary cloud.points_per_spacing=1.0,1.4 --vary support.nodes=8,12,16,24 \
    --vary support.basis=10 --vary support.weight=equal --vary support.max_fe_nodes=7 --vary support.min_domains=6 \
    --vary support.consistency=false --vary support.stabilisation=0.0,0.03,0.5 --vary tumour.surface_nodes=400,1600 \
    --vary ellipsoid.element_size=4,8 --vary hexahedra.hourglass=0.00044 --vary solver.precision=single --vary ranks=2 \
    --vary "solver.method=quasi-static,quasi-static,quasi-static,quasi-static+solver.load_time=0.25,0.5,1,2"
mkdir -p jobs/studies
cp out/study_tumour/study.csv jobs/studies/tumour.csv
cp out/study_tumour/study.png jobs/studies/tumour.png
