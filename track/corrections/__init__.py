"""What an artist says of a tracked take, kept beside it and replayed whenever it is solved again.

`replay.read_corrections` is the door for tracking, `edits` that for whoever writes corrections.
"""
