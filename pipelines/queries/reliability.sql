-- How well the weights of each policy separate correct from wrong labels, after `curate audit` (working database).
SELECT round, frames, overlap, policy, category, labels, right_labels, auroc, auroc_low, auroc_high,
       weighted_precision, weighted_recall, calibration_error
FROM audit
ORDER BY round, frames, overlap, category, auroc DESC
