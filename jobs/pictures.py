"""An example of a picture of one's own, with PyVista: the deformed body cut open, coloured by displacement.

python jobs/pictures.py RUN PICTURE.png [FACTOR] takes the folder of a run; displacements are FACTOR times as large.
ParaView does the same with RUN/result.vtkhdf: Warp By Vector (displacement), then Clip.
"""

import sys

import numpy as np
import pyvista

import mpitled

run, picture, factor = sys.argv[1], sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else 1.0
with mpitled.open_result(run) as result:
    grid = result.to_pyvista(-1)

grid.points *= 1e3  # mm
grid["moved (mm)"] = 1e3 * np.linalg.norm(grid["displacement"], axis=1)
hexahedra = grid.celltypes == pyvista.CellType.HEXAHEDRON
deformed = grid.warp_by_vector("displacement", factor=1e3 * factor)
most = deformed.points[grid["moved (mm)"].argmax()]  # cut where it moves most
colours = {"scalars": "moved (mm)", "cmap": "magma_r", "clim": (0, grid["moved (mm)"].max() or 1.0), "ambient": 0.4}
colours["scalar_bar_args"] = {"vertical": True, "position_x": 0.88, "position_y": 0.25, "fmt": "%.1f"}

pyvista.vtk_verbosity("off")  # no word of screens that are not there
plotter = pyvista.Plotter(off_screen=True, window_size=(1200, 900))
if hexahedra.any():
    half = deformed.extract_cells(hexahedra).clip("x", origin=most, crinkle=True)
    plotter.add_mesh(half, show_edges=True, edge_opacity=0.3, **colours)
cloud = deformed.extract_cells(~hexahedra)  # nodes of the mesh-free cloud, and its integration points
if cloud.n_cells:
    plotter.add_mesh(cloud.clip("x", origin=most), point_size=4, render_points_as_spheres=True, **colours)
plotter.view_vector((1.0, 0.4, 0.3), viewup=(0.0, 0.0, 1.0))
plotter.camera.zoom(1.4)
plotter.add_axes()
plotter.screenshot(picture)
