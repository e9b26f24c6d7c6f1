"""Detection of a part by templates of its mesh, without training.

1. :mod:`~dopepp.inference.templates.views` draws the part from 600 directions.
2. :mod:`~dopepp.inference.templates.responses` finds the image's edges by orientation.
3. :mod:`~dopepp.inference.templates.matching` compares the drawings with the edges at every
   fourth pixel. Drawings are rotated in the image plane and resized to the working distances. Each
   small cell of the image keeps its best matches.
4. :mod:`~dopepp.inference.templates.ranking` moves these matches, replaces their views by better
   neighbouring views, and ranks them.

The result is a list of start poses. Refinement and verification choose among them.
"""
