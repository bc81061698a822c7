"""How fast kinefit is, alone and beside peers, and what it needs of memory and disk."""
