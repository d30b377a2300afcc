-- How well each policy's weight tells right labels from wrong ones, after `curate audit` (working database).
SELECT round, frames, overlap, policy, category, labels, right_labels, auroc, auroc_low, auroc_high,
       weighted_precision, weighted_recall, calibration_error
FROM audit
ORDER BY round, frames, overlap, category, auroc DESC
