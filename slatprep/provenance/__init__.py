"""The records of assets and builds: sources, parameters, versions and quality of every row."""
