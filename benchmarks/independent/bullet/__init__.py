"""The world on Bullet: experiments and their simulation. Only `simulation` imports Bullet."""
