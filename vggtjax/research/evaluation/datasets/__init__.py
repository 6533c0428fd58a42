"""Data sets with ground truth: `table` lists them, and each layout of files has a reader. Does not import jax."""

from vggtjax.research.evaluation.datasets.table import DATASETS as DATASETS
from vggtjax.research.evaluation.datasets.table import Dataset as Dataset
from vggtjax.research.evaluation.datasets.table import chosen_frames as chosen_frames
from vggtjax.research.evaluation.datasets.table import find_sequences as find_sequences
