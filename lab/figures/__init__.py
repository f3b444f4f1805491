"""The paper's figures on MERL-Test, one module each.

`make(bench)` of each evaluates and returns a `sweep.Panel`: tables, charts, numbers. It raises `sweep.LeftOut` where
the figure cannot be made of these methods, shapes or materials, and InputError for scenes that cannot be rendered.
"""
