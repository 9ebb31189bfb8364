"""Define the frame camera: Agisoft Metashape's camera model, its inverse, camera pairs and epipolar rectification.

Reading camera files is in `pipeline/formats/cameras`; the stereo sensor that uses the cameras is in `sensors/stereo`. Start
with `camera.py`.
"""
