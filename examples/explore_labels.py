"""Explore weighted labels with SQL and pandas.

python explore_labels.py                  # labels of curate_results.py, made first if need be
python explore_labels.py labels.sqlite    # any export in the format sqlite
"""

# %% The labels
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

from curate import read_labels

labels = Path(sys.argv[1] if len(sys.argv) > 1 else "work/exports/labels.sqlite")
if not labels.exists():
    import curate_results  # noqa: F401 - makes them

# %% SQL
# An exported file is a plain SQLite database; `curate query --file` asks it from the shell.
query = """
    SELECT category, count(*) AS labels, round(avg(weight), 3) AS mean_weight,
           round(avg(weight > 0.5), 3) AS trusted
    FROM weighted_labels GROUP BY category ORDER BY category
"""
with closing(sqlite3.connect(labels)) as database:
    for row in database.execute(query):
        print(*row, sep="\t")

# %% pandas
# Frame ids stay text, and what is unknown is missing. polars: read_labels(labels, "polars").
table = read_labels(labels, "pandas")
table["distance"] = (table.x**2 + table.y**2) ** 0.5
near_to_far = table.groupby((table.distance // 20 * 20).rename("from_metres"))
print(near_to_far[["score", "points", "rho_diff", "weight"]].mean().round(3))

# %% Labels that the evidence doubts
# A high score with a low weight: the detector is sure, the LiDAR or the image is not.
doubted = table[(table.score > 0.5) & (table.weight < 0.2)]
columns = ["frame", "k", "category", "score", "points", "points_threshold", "weight"]
print(doubted.sort_values("score", ascending=False)[columns].head(10).to_string(index=False))

# %% Frames worth a look
# `curate view FRAME` draws one, `curate explain FRAME K` shows how a weight came about.
by_frame = table.groupby("frame").agg(labels=("k", "size"), weight=("weight", "sum"))
print(by_frame.sort_values("weight").head(5))
