"""The formats of geoelements/gns, the code of Choi & Kumar: its checkpoints and datasets.

weights.import_model        a checkpoint -> LearnedModel, card
dataset.read_dataset        npz or HDF5 -> its trajectories, one by one
dataset.import_dataset      npz or HDF5 -> a folder of trajectory files, to train on
export.export_dataset       a folder of trajectory files -> npz and metadata.json
commands                    the same as commands of gns-model
"""
