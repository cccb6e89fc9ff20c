"""Measurements that a person runs; the page of each figure says which."""
