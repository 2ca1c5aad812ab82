"""Every HDF5 layout: the model, its partitions, the results as VTKHDF, and checkpoints; all with checksums."""

from mpitled.store.checkpoints import (
    CHECKPOINTS,
    checkpoint_contents,
    discard_checkpoints,
    is_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from mpitled.store.columns import read_grid, write_columns
from mpitled.store.files import check_hdf5, has_mpi, hdf5_version, read_rows
from mpitled.store.models import (
    MODEL_ARRAYS,
    check_model,
    describe_model,
    model_contents,
    model_key,
    read_cells,
    read_figures,
    read_model,
    read_points,
    read_remarks,
    read_scene,
    read_sets,
    write_model,
)
from mpitled.store.partitions import (
    BLOCK,
    PartRows,
    has_partition,
    partition_mark,
    read_part,
    write_partition,
)
from mpitled.store.results import Result, is_finished, is_result, is_unfinished, open_result, unfinished_bytes
from mpitled.store.writer import ResultWriter, result_bytes

__all__ = [
    "BLOCK",
    "CHECKPOINTS",
    "MODEL_ARRAYS",
    "PartRows",
    "Result",
    "ResultWriter",
    "check_hdf5",
    "check_model",
    "checkpoint_contents",
    "describe_model",
    "discard_checkpoints",
    "has_mpi",
    "has_partition",
    "hdf5_version",
    "is_checkpoint",
    "is_finished",
    "is_result",
    "is_unfinished",
    "model_contents",
    "model_key",
    "open_result",
    "partition_mark",
    "read_cells",
    "read_checkpoint",
    "read_figures",
    "read_grid",
    "read_model",
    "read_part",
    "read_points",
    "read_remarks",
    "read_rows",
    "read_scene",
    "read_sets",
    "result_bytes",
    "unfinished_bytes",
    "write_checkpoint",
    "write_columns",
    "write_model",
    "write_partition",
]
