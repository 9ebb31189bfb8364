"""Write results in the forms that other programs take: pictures, animations, glTF, YOLO and Hugging Face sets, packages.

File formats that scarpsim itself reads are in `pipeline/formats`.
Start with `pictures.py` or the module named after the form.
"""
