"""Measures whether cuts keep the total alpha and colour of an asset.

`measure` compares an asset, its cuts and its levels with supersampled pictures; `fuzzy`
makes thin and faint assets.
"""
