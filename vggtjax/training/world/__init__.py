"""Scenes of textures, photographs and meshes from a folder of assets: rooms, streets and landscapes with exact truth.

assets -> meshes -> places, actors, cameras -> scene -> casting -> sensor -> clip
"""
