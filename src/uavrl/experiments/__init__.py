"""Experiments as data: what is run, where its rows are kept, and the tables made of them."""
