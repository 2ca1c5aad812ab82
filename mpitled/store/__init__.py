"""All HDF5 file layouts, with checksums: models, their partitions, results as VTKHDF, and checkpoints."""

from mpitled.store.checkpoints import (
    CHECKPOINTS,
    checkpoint_contents,
    discard_checkpoints,
    is_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from mpitled.store.columns import table_contents, write_columns
from mpitled.store.files import has_mpi, hdf5_version, read_rows
from mpitled.store.models import (
    check_model,
    describe_model,
    model_arrays,
    model_contents,
    model_key,
    read_blocks,
    read_figures,
    read_model,
    read_points,
    read_remarks,
    read_scene,
    write_model,
)
from mpitled.store.partitions import (
    PartBlock,
    PartRows,
    has_partition,
    partition_mark,
    read_part,
    write_partition,
)
from mpitled.store.results import EFG_NODE, Result, is_finished, is_result, is_unfinished, open_result, unfinished_bytes
from mpitled.store.writer import ResultWriter, result_bytes

__all__ = [
    "CHECKPOINTS", "EFG_NODE", "PartBlock", "PartRows", "Result", "ResultWriter", "check_model",
    "checkpoint_contents", "describe_model", "discard_checkpoints", "has_mpi", "has_partition", "hdf5_version",
    "is_checkpoint", "is_finished", "is_result", "is_unfinished", "model_arrays", "model_contents", "model_key",
    "open_result", "partition_mark", "read_blocks", "read_checkpoint", "read_figures", "read_model",
    "read_part", "read_points", "read_remarks", "read_rows", "read_scene", "result_bytes", "table_contents",
    "unfinished_bytes", "write_checkpoint", "write_columns", "write_model", "write_partition",
]  # fmt: skip
