-- How many frames each split has.
SELECT split, count(*) AS frames FROM frame GROUP BY split ORDER BY split
