"""References that share no code with the engine: the judge (`judge.py`), and numbers made by other packages."""
