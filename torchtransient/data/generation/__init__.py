"""Data sets made over night: shards by many processes, on one machine or several, that survive what kills them."""
