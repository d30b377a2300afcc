-- Labels with a score above 0.3 and fewer than five LiDAR points inside.
SELECT DISTINCT round, frame, k, category, score, points, points_threshold, x, y, provenance
FROM weighted_labels
WHERE points < 5 AND score > 0.3
ORDER BY score DESC, round, frame, k
