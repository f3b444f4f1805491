"""Exchange with the folder layouts that other photometric-stereo code reads and writes.

`export` turns shards into the layouts of `layouts.LAYOUTS`, `ingest` turns PS-FCN trees and DiLiGenT folders into
shards. docs/reference/formats.md describes the layouts.
"""
