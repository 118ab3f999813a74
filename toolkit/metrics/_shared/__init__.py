"""Parts the metric files share: association, alignment, relative errors, reprojection, triangulation."""
