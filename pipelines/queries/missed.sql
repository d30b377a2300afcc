-- Objects of val frames that no detection matches, after `curate evaluate --store` (working database).
SELECT source, frame, k, category, x, y, length, width, truncated, occluded, iou
FROM evaluation
WHERE side = 'object' AND outcome = 'fn'
ORDER BY source, frame, k
