"""The autonomous loader: the pile decides, the model advises."""
