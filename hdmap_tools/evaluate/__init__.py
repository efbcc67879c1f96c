"""Experiments on simulated drives: the paper's method, and what goes beyond it, against exact truth.

drive + truth ─► point map ─► counts by method ─► observation models ─► scores, tables, pictures
"""
