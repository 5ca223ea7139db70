"""The learned planner: features, datasets, networks, training, model files and chaining."""

__all__ = [
    "checkpoints",
    "dataset",
    "dataset_spec",
    "draws",
    "features",
    "labels",
    "learned",
    "model_files",
    "networks",
    "training",
    "training_set",
    "workers",
]
