# %% [markdown]
# A tumour in a block of brain tissue, from Python: change the deck, compute, and look at what came out.
# Run it as it is (`python jobs/example.py`), or cell by cell in an editor that knows `# %%`.

# %%
import tempfile
from pathlib import Path

import numpy as np

import mpitled

folder = Path(tempfile.mkdtemp())
deck_file = folder / "block.toml"
deck_file.write_text("""
title = "A tumour in a block"
[block]
size = [40.0, 32.0, 32.0]
elements = [10, 8, 8]
cloud = "core"
[tumour]
centre = [20.0, 16.0, 16.0]
volume = 113.1
surface_nodes = 400
[cloud]
radius = 11.0
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "surface"
[solver]
method = "dynamic-relaxation"
load_steps = 200
[output]
frames = 4
""")

# %% The deck: all keys, defaults too, in SI units.
deck = mpitled.load_deck(deck_file, ["cloud.growth=0.3"])
print(f"in {folder}: {deck.title}, {1e9 * deck.tumour.volume:.1f} mm3, cloud.growth = {deck.cloud.growth}")

# %% The model, before anything is computed.
model = mpitled.build_model(deck)
print(f"{model.n_nodes} nodes, {len(model.hexahedra)} hexahedra, {len(model.domains)} support domains")

# %% The run: what it writes into the folder is what `mpitled run` writes.
report = mpitled.run(deck, folder / "out")
print(f"largest displacement {report['max_displacement_mm']:.2f} mm, smallest J {report['min_jacobian']:.3f}")

# %% The result: arrays are read when they are asked for.
with mpitled.open_result(folder / "out") as result:
    size = np.linalg.norm(result.displacement[-1], axis=1)
    far = np.linalg.norm(result.points - deck.tumour.centre, axis=1) > 8e-3
    print(
        f"{len(result.times)} frames; beyond 8 mm of the centre nothing moved more than {1e3 * size[far].max():.2f} mm"
    )
    history = result.history

# %% Tables for pandas, if it is installed: pip install 'mpitled[python]'
try:
    import pandas
except ImportError:
    print("energies, J:", history["strain_energy"])
else:
    print(pandas.DataFrame(history).set_index("time")[["strain_energy", "kinetic_energy", "min_jacobian"]])

# %% The mesh for PyVista, if it is installed: `grid.warp_by_vector("displacement").plot()` shows it.
try:
    with mpitled.open_result(folder / "out") as result:
        print(result.to_pyvista().n_cells, "cells")
except mpitled.InputError as error:
    print(error)
