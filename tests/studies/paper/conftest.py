"""Limit networks to one thread, as in the studies' own processes."""

import torch

torch.set_num_threads(1)
