-- Average precision on val frames, after `curate evaluate --store` (working database).
SELECT source, category, figure, difficulty, objects, ap_r40, ap_r11
FROM evaluation_ap
ORDER BY source, category, figure, difficulty
