"""What tests share: scenes, cases, contracts and oracles. Imported as ``support.NAME``; nothing here is collected."""
