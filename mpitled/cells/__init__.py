"""The kinds of cell: geometry, gradients, stabilisation and masses of each, in one file each."""
