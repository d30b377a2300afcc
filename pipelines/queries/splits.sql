-- Number of frames of each split.
SELECT split, count(*) AS frames FROM frame GROUP BY split ORDER BY split
