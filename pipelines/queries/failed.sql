-- Frames that a stage could not process, with the error (working database).
SELECT round, stage, frame, split, error FROM failed_frames ORDER BY round, stage, frame
