"""Reality: the simulated stand-in for the real world, with other assumptions than the models fitted to it.

`world` has its physics, `run` steps it and `record` records the scripted expert of `expert`; `rigs` are small
experiments; `hidden` has effects that no recording mentions; `sensors` are encoders, trackers and cameras; `appearance`
is the visual appearance. Only `deploy`, the command line, tests, benchmarks and examples may import it.
"""
