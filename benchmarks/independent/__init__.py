"""Benchmark of the diagnosis on data of simulated worlds whose physics share nothing with the library.

`data_set` defines a data set and what making it returns, `worlds` lists all sets and makes them, `split` locks a part
of them. The world on MuJoCo is in the modules `mujoco_*`, those on Drake and on Bullet are in `drake_world`,
`bullet_world` and the folders `drake` and `bullet`, and what these two have in common is in `foreign`. `python -m
benchmarks.independent` diagnoses, `scoring` judges the results and `page` writes them down.
"""
