"""Fits: the parameters for which a problem agrees best with data, and how well the data determine them."""
