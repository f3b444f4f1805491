"""SDPS-Net: self-calibrating deep photometric stereo (Chen et al., CVPR 2019), its training and its use.

Frame everywhere: x right, y up, z to the camera; light vectors point from the surface to the light;
radiance is linear, and a white Lambertian surface facing a light is 1.0.
"""
