-- False positives on val frames, highest score first, after `curate evaluate --store` (working database).
SELECT source, frame, k, category, score, iou, x, y, length, width
FROM evaluation
WHERE side = 'detection' AND outcome = 'fp'
ORDER BY score DESC, source, frame, k
