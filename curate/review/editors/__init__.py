"""The formats in which boxes go to people and come back."""
