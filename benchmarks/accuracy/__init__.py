"""How exact the results are, and whether their error bars say so."""
