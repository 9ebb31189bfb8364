"""Let rocks fall from a wall over time: when, how large, how they move before, and where their fragments come to rest.

Start with `events.py` (the times and volumes) and `evolution.py` (the wall from one time to the next).
"""
