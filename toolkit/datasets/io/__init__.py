"""What several recording formats share: fields with checks, streaming, tables, stamps, truth files."""
