"""The world on Drake: experiments and their simulation. Only `simulation` imports Drake."""
