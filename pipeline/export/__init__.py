"""Export results for other programs: pictures, animations, glTF, YOLO and Hugging Face data sets, Data Packages.

File formats that scarpsim itself reads are in `pipeline/formats`. Start with `pictures.py` or the module named after the form.
"""
