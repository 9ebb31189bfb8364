"""Write the report of `scarpsim gap`: sentences, maps, gap.json.

The numbers come from `pipeline/gap/naming`. Start with `report.py`.
"""
