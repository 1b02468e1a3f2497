"""The world on Drake: experiments, simulation, hidden effects, recordings. Only `simulation` imports Drake."""
