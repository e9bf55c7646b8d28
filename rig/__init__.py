"""The face rig: template transfer, weights, blendshape update, export."""
